"""What places say of who is who: what stayed is told in any frame, and neighbors are compared as others are."""

import dataclasses

import jax
import numpy as np
import pytest

from more2_jax.config import EvidenceMatcher, SurfaceSearch
from more2_jax.geometry.poses import apply_pose
from more2_jax.matching.assignment import assign, interchangeable
from more2_jax.matching.calibration import CARRIED, UPRIGHT, Compared, log_odds
from more2_jax.matching.candidates import PORTABLE_M, align_candidates, odds_of, portable
from more2_jax.matching.metric_evidence import seen_in
from more2_jax.matching.pair_evidence import PairEvidence
from more2_jax.matching.places import (
    BESIDE_M,
    FREE_SHARE,
    OTHER_COLOR,
    in_place,
    lie_on,
    motion_odds,
    on_each_other,
    stayed,
    with_neighbors,
)
from more2_jax.network.embedding_batch import embed
from more2_jax.types import ObservedObject

MATCHER = EvidenceMatcher(candidates=0, search=SurfaceSearch(steps=6, dense=256, cells=8, free_weight=0.0))
SIZES = [np.array(s) for s in ([1.0, 0.5, 0.6], [0.5, 0.6, 1.0], [1.4, 0.4, 0.3])]
SHIFT = np.array([[0.0, 0, 0], [0, 0, 0], [1.5, 0.8, 0]])  # the third moved


def cloud(rng, size, turn_deg=0.0, count=500):
    """A box with a ridge along one edge, so that no turn leaves it as it is; standing on z = 0."""
    points = rng.uniform(-0.5, 0.5, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-0.5, 0.5], count)
    ridge = rng.uniform(-0.5, 0.5, (150, 3)) * [0.3, 0.2, 0.5] + [0.35, 0.3, 0.75]
    points = np.concatenate([points, ridge]) * size + [0, 0, size[2] / 2]
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])


def observed(prior, clouds):
    return [ObservedObject(points=p, embedding=e) for p, e in zip(clouds, embed(prior, clouds), strict=True)]


@pytest.fixture(scope="module")
def room(tiny_prior):
    """Three things, and the same seen again: two where they were, one elsewhere and turned."""
    rng = np.random.default_rng(0)
    first = [cloud(rng, size) + [3.0 * k, 0, 0] for k, size in enumerate(SIZES)]
    second = [cloud(rng, size, 70.0 * (k == 2)) + [3.0 * k, 0, 0] + SHIFT[k] for k, size in enumerate(SIZES)]
    return first, second


def aligned_at(prior, first, second, T=None, matcher=MATCHER):
    sides = [observed(prior, c) for c in (first, second)]
    return align_candidates(prior, *sides, matcher, "upright", T)


def told(aligned, T):
    return {tuple(r) for r in aligned.rows[stayed(aligned, T)].tolist()}


def test_what_stayed_is_told_in_whatever_frame_the_scan_is(tiny_prior, room):
    first, second = room
    assert told(aligned_at(tiny_prior, first, second), np.eye(4)) == {(0, 0), (1, 1)}
    T = np.eye(4)
    T[:2, :2] = [[0, -1], [1, 0]]
    T[:3, 3] = [5.0, -2.0, 0.0]
    elsewhere = [apply_pose(np.linalg.inv(T), c) for c in second]
    aligned = aligned_at(tiny_prior, first, elsewhere, T)
    assert told(aligned, T) == {(0, 0), (1, 1)}
    assert told(aligned, np.eye(4)) == set()


def test_of_copies_that_stayed_none_changes_places_though_others_fit_better(tiny_prior):
    rng = np.random.default_rng(1)
    first, second = ([cloud(rng, SIZES[0]) + [3.0 * k, 0, 0] for k in range(2)] for _ in range(2))
    aligned = aligned_at(tiny_prior, first, second)
    odds = odds_of(aligned, MATCHER.search, "upright")
    assert (odds.value > 0).all()
    odds = dataclasses.replace(odds, value=np.array([1.0, 3.0, 3.0, 1.0]))  # as damaged masks may have it
    assert assign(odds).tolist() == [[0, 1], [1, 0]]
    pairs = assign(odds, motion_odds(aligned, np.eye(4), MATCHER, "upright"))
    assert pairs.tolist() == [[0, 0], [1, 1]]
    assert interchangeable(odds, pairs) == [True, True]
    red_and_blue = dataclasses.replace(aligned.compared, color=np.array([OTHER_COLOR - 1, 2.0, 2.0, -2.0]))
    swapped = dataclasses.replace(aligned, compared=red_and_blue)
    pairs = assign(odds, motion_odds(swapped, np.eye(4), MATCHER, "upright"))
    assert pairs.tolist() == [[0, 1], [1, 0]]  # where one stood, another stands now


def test_motion_adds_nothing_to_what_went_far_but_a_bounded_cost(tiny_prior, room):
    aligned = aligned_at(tiny_prior, *room)
    motion = motion_odds(aligned, np.eye(4), MATCHER, "upright")
    here = np.array([tuple(r) in {(0, 0), (1, 1)} for r in aligned.rows.tolist()])
    np.testing.assert_allclose(motion[here], MATCHER.stayed_weight, atol=0.05)
    assert (motion[~here] < 0).all()
    far = np.eye(4)
    far[0, 3] = 1e4
    for motion, share in (("upright", 1.0), ("free", FREE_SHARE)):
        least = motion_odds(aligned, far, MATCHER, motion).min()
        assert least == pytest.approx(-10 * share * MATCHER.motion_weight)


def test_neighbors_are_compared_as_if_they_had_been_proposed(tiny_prior, room):
    first, second = room
    half = [first[0][first[0][:, 0] < 0], *first[1:]]
    every = aligned_at(tiny_prior, half, second)
    few = aligned_at(tiny_prior, half, second, matcher=dataclasses.replace(MATCHER, candidates=1))
    assert len(few.rows) < len(every.rows)
    kept = ~np.isin(few.rows @ [3, 1], [0])  # as if (0, 0) had not been proposed
    fewer = without(few, kept)
    found = with_neighbors(tiny_prior, fewer, MATCHER, "upright", np.eye(4))
    listed = [tuple(r) for r in found.rows.tolist()]
    assert listed == sorted(set(listed))
    assert set(listed) == {tuple(r) for r in fewer.rows.tolist()} | {(0, 0), (1, 1)}
    at = every.rows_of(listed)
    expected = odds_of(every, MATCHER.search, "upright").value[at]
    np.testing.assert_allclose(odds_of(found, MATCHER.search, "upright").value, expected, atol=1e-4)
    np.testing.assert_allclose(found.T_old_new, every.T_old_new[at], atol=1e-4)
    again = with_neighbors(tiny_prior, found, MATCHER, "upright", np.eye(4))
    assert again is found  # nothing is left to compare
    away = np.eye(4)
    away[1, 3] = 2 * BESIDE_M
    assert with_neighbors(tiny_prior, fewer, MATCHER, "upright", away) is fewer


def test_an_end_of_what_is_long_is_compared_with_the_whole_though_their_centers_are_apart(tiny_prior):
    rng = np.random.default_rng(3)
    long = cloud(rng, np.array([3.0, 0.5, 0.6]), count=4000)
    end = long[long[:, 0] < -0.9]
    others = [cloud(rng, SIZES[1]) + [6.0, 2.0 * k, 0] for k in range(2)]
    T = np.eye(4)
    T[:2, :2] = [[0, -1], [1, 0]]
    T[:3, 3] = [5.0, -2.0, 0.0]
    seen = [apply_pose(np.linalg.inv(T), c) for c in (end, others[0])]
    assert np.linalg.norm(long.mean(axis=0) - end.mean(axis=0)) > BESIDE_M
    for old, new, found in (
        ([long, *others], seen, {(0, 0), (1, 1)}),
        (seen, [long, *others], {(0, 0), (1, 1)}),
    ):
        place = T if old is not seen else np.linalg.inv(T)
        aligned = aligned_at(tiny_prior, old, new, place)
        assert on_each_other(aligned, place) == found
        assert on_each_other(aligned, place, {(0, 0), (2, 1)}) == {(1, 1)}
        assert on_each_other(aligned, np.eye(4)) == set()
        kept = ~(aligned.rows == 0).all(axis=1)  # as if it had not been proposed
        fewer = without(aligned, kept)
        again = with_neighbors(tiny_prior, fewer, MATCHER, "upright", place)
        assert {tuple(r) for r in again.rows.tolist()} == {tuple(r) for r in aligned.rows.tolist()}


def without(aligned, kept):
    """The pairs that are kept alone."""
    return dataclasses.replace(
        aligned,
        rows=aligned.rows[kept],
        stayed=jax.tree.map(lambda x: x[kept], aligned.stayed),
        found=jax.tree.map(lambda x: x[kept], aligned.found),
        T_old_new=aligned.T_old_new[kept],
        compared=Compared(
            **{f.name: getattr(aligned.compared, f.name)[kept] for f in dataclasses.fields(Compared)}
        ),
        top_gap_m=aligned.top_gap_m[kept],
        off=aligned.off[kept],
        off_own=aligned.off_own[kept],
        metric=dataclasses.replace(
            aligned.metric, apart=aligned.metric.apart[kept], contradicted=aligned.metric.contradicted[kept]
        ),
    )


def test_heights_say_little_of_what_is_small():
    surely, hardly = PORTABLE_M
    np.testing.assert_allclose(portable(np.array([0.1, surely, hardly, 2.0])), [1, 1, 0, 0], atol=1e-12)
    assert (np.diff(portable(np.linspace(0, 2, 50))) <= 0).all()
    fields = ("off_source", "off_target", "apart_source", "apart_target", "contradicted", "off_own")
    nothing = {k: np.zeros(3) for k in fields}
    evidence = PairEvidence(
        pose=np.zeros(3, int), radius_m=np.ones(3), lift_m=np.array([0.0, 0.8, 0.8]), **nothing
    )
    zero = {k: np.zeros(3) for k in ("size", "likeness", "color")}
    known = Compared(**zero, top_m=np.array([0.0, 0.8, 0.8]), portable=np.array([0.0, 0.0, 1.0]))
    same, large, small = log_odds(evidence, known, UPRIGHT)
    assert same - large == pytest.approx(-(UPRIGHT.lift + UPRIGHT.top))
    assert same - small == pytest.approx((1 - CARRIED) * (same - large))


def sliver(points):
    """What a scan sees of a thing from far aside."""
    return points[points[:, 0] <= np.quantile(points[:, 0], 0.15)]


def lying(aligned, T):
    rows = in_place(aligned, np.ones(len(aligned.rows), bool), T)
    return {tuple(r) for r in aligned.rows[rows].tolist()}


def test_a_sliver_lies_on_what_it_is_of_whichever_scan_saw_it(tiny_prior):
    rng = np.random.default_rng(2)
    first = [cloud(rng, size, count=4000) + [3.0 * k, 0, 0] for k, size in enumerate(SIZES)]
    second = [cloud(rng, size, count=4000) + [3.0 * k, 0, 0] + SHIFT[k] for k, size in enumerate(SIZES)]
    T = np.eye(4)
    T[:2, :2] = [[0, -1], [1, 0]]
    T[:3, 3] = [5.0, -2.0, 0.0]
    seen = [apply_pose(np.linalg.inv(T), c) for c in (sliver(second[0]), second[1], sliver(second[2]))]
    aligned = aligned_at(tiny_prior, [first[0], sliver(first[1]), first[2]], seen, T)
    assert {(0, 0), (1, 1)} <= {tuple(r) for r in aligned.rows.tolist()}
    assert lying(aligned, T) == {(0, 0), (1, 1)}  # the third moved
    assert lying(aligned, np.eye(4)) == set()
    other = dataclasses.replace(aligned.compared, color=np.full(len(aligned.rows), OTHER_COLOR - 1))
    assert lying(dataclasses.replace(aligned, compared=other), T) == set()
    none = in_place(aligned, np.zeros(len(aligned.rows), bool), T)
    assert not none.any()


def test_lying_on_each_other_has_no_direction_and_a_scale_that_of_the_larger():
    rng = np.random.default_rng(0)
    whole = cloud(rng, SIZES[0], count=4000)
    part, beside = sliver(whole), whole + [0.0, 0.0, 0.5]
    assert lie_on(part, whole) == lie_on(whole, part) == 1.0
    assert lie_on(whole, beside) == lie_on(beside, whole) < 0.5
    assert lie_on(part, part[:1]) == 1.0  # a point alone
    cup, other_cup = 0.05 * whole, 0.05 * cloud(rng, SIZES[1], count=4000)
    assert lie_on(cup, other_cup) < 0.9  # though all of it is within centimeters
    assert lie_on(20.0 * cup, 20.0 * other_cup) == pytest.approx(lie_on(cup, other_cup), abs=0.1)


@pytest.mark.parametrize(("floor_to", "one_object"), [(0.2, True), (1.0, False)])
def test_a_part_is_no_sliver_where_the_scan_saw_past_the_rest(tiny_prior, floor_to, one_object):
    whole = [cloud(np.random.default_rng(k), SIZES[0], count=4000) + [0, 0, 0.2] for k in range(2)]
    steps = np.arange(-0.6, 0.6, 0.03)
    floor = np.stack([*np.meshgrid(steps, steps), np.zeros((len(steps),) * 2)], axis=-1).reshape(-1, 3)
    looked_at = floor[floor[:, 0] < np.quantile(floor[:, 0], floor_to)]
    sides = observed(tiny_prior, whole[:1]), observed(tiny_prior, [sliver(whole[1])])
    seen = seen_in(*sides, scan=looked_at)
    aligned = align_candidates(tiny_prior, *sides, MATCHER, "upright", seen=seen)
    assert lying(aligned, np.eye(4)) == ({(0, 0)} if one_object else set())
    unseen = dataclasses.replace(aligned, seen=None)
    assert lying(unseen, np.eye(4)) == {(0, 0)}
