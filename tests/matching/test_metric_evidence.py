"""Distances in meters between pairs of clouds, and what of them the other scan shows to be empty."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from more2_jax.config import EvidenceMatcher, SurfaceSearch, preset
from more2_jax.geometry.poses import apply_pose
from more2_jax.matching.calibration import UPRIGHT
from more2_jax.matching.candidates import align_candidates, evidence_at, measured_within, odds_of
from more2_jax.matching.metric_evidence import (
    APART_M,
    MOST_APART_M,
    NOISES,
    apart_within,
    metric_evidence,
    samples_of,
    seen_in,
)
from more2_jax.network.embedding_batch import embed
from more2_jax.registration.pair_batch import local_batch
from more2_jax.registration.search import alignable
from more2_jax.tracking.comparison import Comparison
from more2_jax.tracking.identify import Identified
from more2_jax.tracking.scan_frame import among_noise
from more2_jax.tracking.scan_height import Weighed
from more2_jax.types import Frame, ObservedObject

SEARCH = SurfaceSearch(points=64, dense=128, cells=8, turns=4, steps=2)
UP = np.array([[0.0, -1, 0, 0.3], [1, 0, 0, 0.2], [0, 0, 1, 0.05], [0, 0, 0, 1]])


def box(size, at, count=500, seed=0):
    """Points on the surface of a box that stands on z = 0."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-0.5, 0.5], count)
    return (points + [0, 0, 0.5]) * size + at


def floor(side=6.0):
    x = np.arange(-1.0, side, 0.07)
    return np.stack([*np.meshgrid(x, x), np.zeros((len(x), len(x)))], axis=-1).reshape(-1, 3)


@pytest.fixture(scope="module")
def scans(tiny_prior):
    """Two boxes of the scene, and of a scan."""

    def observed(clouds):
        return [
            ObservedObject(points=p, embedding=e)
            for p, e in zip(clouds, embed(tiny_prior, clouds), strict=True)
        ]

    old = observed([box([1, 0.5, 0.7], [0, 0, 0]), box([0.4, 0.4, 1.2], [3, 0, 0], seed=1)])
    new = observed([box([1, 0.5, 0.7], [0.5, 2, 0], seed=2), box([0.4, 0.4, 1.2], [3, 3, 0], seed=3)])
    return old, new


def compare(scans, pairs, poses, seen, apart_m=APART_M):
    old, new = scans
    batches = local_batch(new), local_batch(old)
    ready = tuple(alignable(b, SEARCH) for b in batches)
    samples = tuple(samples_of(r, b.origin) for r, b in zip(ready, batches, strict=True))
    return (
        metric_evidence((new, old), samples, np.array(pairs), np.array(poses), seen, apart_m),
        batches,
        ready,
    )


@pytest.mark.parametrize("apart_m", [APART_M, 0.15])
def test_by_definition_of_every_pair_and_pose(scans, apart_m):
    old, new = scans
    seen = seen_in(old, new, floor(), floor())
    poses = np.stack([np.stack([UP, np.eye(4)])] * 2)
    found, batches, ready = compare(scans, [[0, 0], [1, 0]], poses, seen, apart_m)
    for p, (i, k) in enumerate([(0, 0), (1, 0)]):
        for q, T in enumerate((UP, np.eye(4))):
            shares = []
            for way, (row, cloud, X) in enumerate(((i, old[k], T), (k, new[i], np.linalg.inv(T)))):
                sampled = ready[way].coarse.sampled
                own = np.asarray(sampled.points[row], np.float64)[np.asarray(sampled.mask[row])]
                moved = apply_pose(X, own + batches[way].origin[row])
                distance = KDTree(cloud.points).query(moved)[0]
                by_hand = np.minimum(distance / apart_m, 1).mean()
                assert found.apart[p, q, way] == pytest.approx(by_hand, abs=1e-9)
                shares.append((seen[way].empty(moved, APART_M) & (distance >= apart_m)).mean())
            assert found.contradicted[p, q] == pytest.approx(max(shares))


def test_what_lies_around_the_other_counts_as_the_other_itself(scans):
    """A mask that is cut: its rest in the background is no distance; its own sample stays its own."""
    old, new = scans
    left = old[0].points[:, 0] < 0
    half = dataclasses.replace(old[0], points=old[0].points[left])
    rest = dataclasses.replace(half, around=old[0].points[~left])
    T = np.eye(4)
    T[:3, 3] = [-0.5, -2, 0]
    pairs, poses = [[0, 0]], [[T]]
    whole, cut, mended = (
        compare(([o], new[:1]), pairs, poses, None)[0].apart[0, 0] for o in (old[0], half, rest)
    )
    assert cut[0] > whole[0] + 0.1
    assert mended[0] == pytest.approx(whole[0], abs=1e-9)
    assert mended[1] == pytest.approx(cut[1], abs=0.1)  # another sample of the same points


def test_moving_a_scan_as_a_whole_changes_nothing(tiny_prior, scans):
    """By whole columns: which points share one is what a scan's own grid says."""
    old, new = scans
    room = floor()
    shift = np.array([3.0, -1.5, 0.4])  # 20 and 10 columns
    matcher = EvidenceMatcher(search=SEARCH)
    there = [dataclasses.replace(o, points=o.points + shift) for o in new]
    there = [
        dataclasses.replace(o, embedding=e)
        for o, e in zip(there, embed(tiny_prior, [o.points for o in there]), strict=True)
    ]
    back = np.eye(4)
    back[:3, 3] = -shift
    here = align_candidates(tiny_prior, old, new, matcher, "upright", None, seen_in(old, new, room, room))
    moved = align_candidates(
        tiny_prior, old, there, matcher, "upright", back, seen_in(old, there, room, room + shift)
    )
    np.testing.assert_allclose(moved.metric.apart, here.metric.apart, atol=2e-3)
    np.testing.assert_allclose(moved.metric.contradicted, here.metric.contradicted, atol=0.05)


def test_a_half_whose_other_half_is_in_the_background_is_not_contradicted(tiny_prior, scans):
    """A mask that is cut: what it lost is still in its scan. Where nothing stands there, the scan says so."""
    dense = box([1, 0.5, 0.7], [0, 0, 0], count=4000)
    old = [dataclasses.replace(scans[0][0], points=dense, embedding=embed(tiny_prior, [dense])[0])]
    whole = box([1, 0.5, 0.7], [0.5, 2, 0], count=4000, seed=2)
    left = whole[:, 0] < np.median(whole[:, 0])
    half = [ObservedObject(points=whole[left], embedding=embed(tiny_prior, [whole[left]])[0])]
    T = np.eye(4)
    T[:3, 3] = [-0.5, -2, 0]
    cut, gone = (
        compare((old, half), [[0, 0]], [[T]], seen_in(old, half, floor(), rest))[0].contradicted[0, 0]
        for rest in (np.concatenate([floor(), whole[~left]]), floor())
    )
    assert cut < 0.05
    assert gone > 0.3


def test_empty_space_lowers_the_odds_and_is_asked_upright_alone(tiny_prior, scans):
    old, new = scans
    matcher = EvidenceMatcher(search=SEARCH)
    with_room, without = (
        align_candidates(tiny_prior, old, new, matcher, "upright", None, seen_in(old, new, room, room))
        for room in (floor(), np.zeros((0, 3)))
    )
    more, less = (odds_of(x, SEARCH, "upright").value for x in (without, with_room))
    told, untold = (evidence_at(x, SEARCH, "upright").contradicted for x in (with_room, without))
    shares = told - untold
    assert (shares >= 0).all() and shares.max() > 0.05
    np.testing.assert_allclose(less - more, UPRIGHT.contradicted * shares, atol=1e-6)
    free = align_candidates(
        tiny_prior, old, new, EvidenceMatcher(search=dataclasses.replace(SEARCH, field_weight=0.0)), "free"
    )
    assert free.seen is None and not free.metric.contradicted.any() and free.metric.apart.any()
    assert jnp.isfinite(odds_of(free, SEARCH, "free").value).all()


def test_so_many_times_the_noise_is_near_within_bounds():
    assert apart_within(0.0) == apart_within(APART_M / NOISES) == APART_M
    assert apart_within(0.02) == pytest.approx(NOISES * 0.02)
    assert apart_within(1.0) == MOST_APART_M


def test_among_noise_pairs_are_compared_anew_at_the_same_poses(tiny_prior, scans):
    matcher, rng = EvidenceMatcher(search=SEARCH), np.random.default_rng(0)
    old, new = scans
    noisy = [
        dataclasses.replace(o, points=o.points + rng.normal(0, 0.03, o.points.shape).round(4)) for o in new
    ]
    aligned = align_candidates(
        tiny_prior, old, noisy, matcher, "upright", None, seen_in(old, noisy, floor(), floor())
    )
    weighed = Weighed(height_m=0.01, aligned=aligned, odds=odds_of(aligned, SEARCH, "upright", 0.01))
    again = measured_within(aligned, APART_M)
    np.testing.assert_array_equal(again.metric.apart, aligned.metric.apart)
    np.testing.assert_array_equal(again.metric.contradicted, aligned.metric.contradicted)
    assert among_noise(weighed, 0.01, matcher, "upright") is weighed
    wider = among_noise(weighed, 0.03, matcher, "upright")
    np.testing.assert_array_equal(wider.aligned.T_old_new, aligned.T_old_new)
    assert wider.height_m == weighed.height_m
    alike = [tuple(pair) in {(0, 0), (1, 1)} for pair in wider.odds.pairs.tolist()]
    gain = wider.odds.value - weighed.odds.value
    assert (gain[alike] > 0.5).all()  # noise speaks less against what is one object
    assert wider.odds.value[alike].min() > wider.odds.value[~np.array(alike)].max()


def test_clouds_that_are_compared_later_are_compared_among_the_same_noise(tiny_prior, scans):
    old, new = scans
    config = dataclasses.replace(preset("robust", upright=True), matching=EvidenceMatcher(search=SEARCH))
    pairs = align_candidates(tiny_prior, old, new, config.matching, "upright")
    odds = list[dict[tuple[int, int], float]]()
    for noise_m in (0.0, 0.01, 0.03):
        known = Identified(frame=Frame(noise_m=noise_m), aligned=pairs)
        compared = Comparison.of(tiny_prior, old, new, known, config)
        assert compared is not None
        odds.append(compared.odds_of_others(old, new))
    assert odds[0] == odds[1] and odds[0].keys() == odds[2].keys()
    assert all(odds[2][pair] > odds[0][pair] for pair in [(0, 0), (1, 1)])


def test_pairs_are_weighed_alike_however_many_are_held_at_once(tiny_prior, scans, monkeypatch):
    old, new = scans
    config = dataclasses.replace(preset("robust", upright=True), matching=EvidenceMatcher(search=SEARCH))
    pairs = align_candidates(tiny_prior, old, new, config.matching, "upright")
    compared = Comparison.of(tiny_prior, old, new, Identified(aligned=pairs), config)
    assert compared is not None
    together = compared.odds_of_others(old, new)
    monkeypatch.setattr("more2_jax.tracking.comparison.PAIRS_AT_ONCE", 1)
    apart = compared.odds_of_others(old, new)
    assert len(together) > 2 and list(apart) == list(together)
    np.testing.assert_allclose(list(apart.values()), list(together.values()), atol=1e-4)
