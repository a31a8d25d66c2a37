"""Who is who by geometry: what is assigned, what is left over and how surely, and which copies are interchangeable."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.special import expit

from more2_jax.config import EvidenceMatcher, SurfaceSearch, preset
from more2_jax.geometry.point_to_plane import coarsened, whole_surface
from more2_jax.geometry.poses import vertical_shift
from more2_jax.matching import candidates
from more2_jax.matching.assignment import (
    FARTHEST_M,
    LEAST_GAIN,
    NEVER,
    LogOdds,
    assign,
    interchangeable,
    unmatched,
)
from more2_jax.matching.calibration import (
    FREE,
    HIGHEST_M,
    MOST_LIFT_M,
    UNASKED,
    UNKNOWN,
    UPRIGHT,
    Calibration,
    Compared,
    calibrated,
    log_odds,
)
from more2_jax.matching.candidates import align_candidates, evidence_at, odds_of
from more2_jax.matching.pair_evidence import PairEvidence
from more2_jax.network.embedding_batch import embed
from more2_jax.network.prior import load_prior
from more2_jax.registration.pose_costs import field_cost, off_field, off_fields
from more2_jax.types import ObservedObject

FIELDS = (
    *("off_source", "off_target", "apart_source", "apart_target"),
    *("contradicted", "lift_m"),
)


def box(rng, size, count=600):
    """Points on the surface of a box that stands on z = 0."""
    points = rng.uniform(-0.5, 0.5, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-0.5, 0.5], count)
    return points * size + [0, 0, size[2] / 2]


def assigned(matrix, moved_m=0.0, weight=0.0):
    """The assignment of a matrix of log odds, every pair moved by so many meters."""
    odds = LogOdds.of(np.asarray(matrix))
    far = np.minimum(np.broadcast_to(moved_m, odds.shape)[tuple(odds.pairs.T)], FARTHEST_M)
    return assign(odds, -weight * far)


def test_only_what_is_likelier_one_than_two_is_matched():
    odds = np.array([[2.0, 1.0], [3.0, -0.5], [-1.0, -2.0]])
    assert assigned(odds).tolist() == [[0, 1], [1, 0]]
    assert assigned(-np.abs(odds)).tolist() == []
    assert assigned(np.full((2, 2), NEVER), weight=1.0).tolist() == []


@pytest.mark.parametrize("seed", range(4))
def test_a_sparse_assignment_is_that_of_the_whole_matrix(seed):
    """Pairs of separate rooms, and of all of them together: SciPy's assignment of the whole matrix is the oracle."""
    rng = np.random.default_rng(seed)
    odds = rng.normal(1.0, 3.0, (30, 40))
    odds[rng.random(odds.shape) > (0.05, 0.1, 0.5, 1.0)[seed]] = NEVER
    odds, moved = odds[rng.permutation(30)], rng.uniform(0, 20, odds.shape)
    gain = np.where(odds > 0, np.maximum(odds - 0.2 * np.minimum(moved, FARTHEST_M), LEAST_GAIN * odds), 0.0)
    rows = np.stack(linear_sum_assignment(-gain), axis=1)
    expected = rows[gain[tuple(rows.T)] > 0]
    assert len(expected) > 5
    assert assigned(odds, moved, 0.2).tolist() == expected.tolist()


def test_of_identical_copies_each_stays_as_near_as_can_be_and_is_flagged():
    odds = np.array([[3.0, 3.1, -4], [3.1, 3.0, -4], [-4, -4, 3.0]])
    moved = np.array([[0.0, 3.0, 9], [3.0, 0.0, 9], [9, 9, 0.0]])
    pairs = assigned(odds, moved, 0.2)
    assert pairs.tolist() == [[0, 0], [1, 1], [2, 2]]
    assert assigned(odds, moved, 0.0).tolist() == [[0, 1], [1, 0], [2, 2]]
    assert interchangeable(LogOdds.of(odds), pairs) == [True, True, False]


def test_a_copy_that_went_makes_the_other_interchangeable_and_far_motion_alone_rejects_none():
    odds = np.array([[3.0, -4], [2.9, -4]])
    pairs = assigned(odds, np.array([[1.0, 5], [100.0, 5]]), 0.2)
    assert pairs.tolist() == [[0, 0]]
    assert interchangeable(LogOdds.of(odds), pairs) == [True]
    assert assigned([[0.5]], 100.0, 0.2).tolist() == [[0, 0]]


def test_log_odds_are_linear_and_the_two_ways_have_no_order():
    rng = np.random.default_rng(0)
    values = {k: rng.uniform(size=3) for k in FIELDS}
    evidence = PairEvidence(pose=np.zeros(3, int), radius_m=np.full(3, 0.5), off_own=np.zeros(3), **values)
    known = Compared(**{k: rng.uniform(size=3) for k in ("size", "likeness", "top_m", "color")})
    c = Calibration(
        intercept=1.0,
        likeness=5.0,
        lift=6.0,
        top=7.0,
        off_less=8.0,
        off_more=9.0,
        apart_less=10.0,
        apart_more=11.0,
        contradicted=12.0,
    )
    by_hand = 1 + 5 * known.likeness + known.color + 12 * values["contradicted"]
    by_hand += 6 * np.minimum(values["lift_m"] / MOST_LIFT_M, 1) + 7 * np.minimum(known.top_m / HIGHEST_M, 1)
    for k, less, more in (("off", 8, 9), ("apart", 10, 11)):
        a, b = values[f"{k}_source"], values[f"{k}_target"]
        by_hand += less * np.minimum(a, b) + more * np.maximum(a, b)
    np.testing.assert_allclose(log_odds(evidence, known, c), by_hand)


def test_the_prior_is_asked_in_any_orientation_alone_and_only_where_it_knows_the_clouds():
    rng = np.random.default_rng(0)
    evidence = PairEvidence(
        pose=np.zeros(3, int),
        radius_m=np.full(3, 0.5),
        off_own=np.array([0.0, UNKNOWN, UNKNOWN + 0.1]),
        **{k: rng.uniform(size=3) for k in FIELDS},
    )
    known = Compared(**{k: rng.uniform(size=3) for k in ("size", "likeness", "top_m", "color")})
    search = SurfaceSearch()
    by = {c: log_odds(evidence, known, c) for c in (UPRIGHT, FREE, UNASKED)}
    np.testing.assert_array_equal(calibrated(evidence, known, search, "upright"), by[UPRIGHT])
    found = calibrated(evidence, known, search, "free")
    np.testing.assert_array_equal(found, [*by[FREE][:2], by[UNASKED][2]])
    without = dataclasses.replace(search, field_weight=0.0)
    np.testing.assert_array_equal(calibrated(evidence, known, without, "free"), by[UNASKED])
    assert not (UPRIGHT.off_less or UPRIGHT.off_more or UNASKED.off_less or UNASKED.off_more)
    # Which way is up, so what lies below, is known of upright things alone.
    assert UPRIGHT.contradicted and not any(
        (c.contradicted, c.lift, c.top) != (0, 0, 0) for c in (FREE, UNASKED)
    )


def observed(prior, clouds):
    return [ObservedObject(points=p, embedding=e) for p, e in zip(clouds, embed(prior, clouds), strict=True)]


@pytest.mark.slow
def test_in_any_orientation_the_evidence_is_that_of_the_best_pose(tiny_prior):
    rng = np.random.default_rng(3)
    new, old = (
        observed(tiny_prior, [box(rng, np.array([1.0, 0.5, 0.6]), 200) + [k, 0, 0]]) for k in range(2)
    )
    search = SurfaceSearch(steps=4, dense=256, cells=8)
    aligned = align_candidates(tiny_prior, old, new, EvidenceMatcher(search=search), "free")
    found = evidence_at(aligned, search, "free")
    pair = aligned.take([(0, 0)])
    sides = [
        jax.tree.map(lambda x: jnp.asarray(x[0]), dataclasses.replace(side, origin=None))
        for side in (pair.source, pair.target)
    ]
    sample = jax.jit(lambda p, m: coarsened(whole_surface(p, m), 128, 256, 8).sampled)
    sampled = [sample(x.cloud.points, x.cloud.mask) for x in sides]
    codes = [x.code for x in sides]
    T = jax.tree.map(lambda x: x[0], aligned.found.poses)
    off = jax.jit(off_fields)(tiny_prior, T, tuple(sampled), tuple(codes))
    np.testing.assert_allclose([found.off_source[0], found.off_target[0]], off[0], atol=1e-3)
    cost = jnp.asarray(aligned.found.cost[0])
    cost += field_cost(cost, off.mean(axis=1), search.field_weight)
    assert float(cost[0]) <= float(cost.min()) + 1e-2
    own = [
        jax.jit(off_field)(tiny_prior, jaxlie.SE3.identity(), c, e)
        for c, e in zip(sampled, codes, strict=True)
    ]
    np.testing.assert_allclose(found.off_own[0], max(own), atol=1e-3)


@pytest.mark.parametrize("motion", [pytest.param("free", marks=pytest.mark.slow), "upright"])
def test_of_many_objects_less_is_kept_and_registration_is_handed_the_same(tiny_prior, monkeypatch, motion):
    rng = np.random.default_rng(3)
    sizes = ([1.0, 0.5, 0.6], [0.4, 0.5, 0.9])
    new, old = (
        observed(
            tiny_prior, [box(rng, np.array(size), 200) + [k, 2.0 * n, 0] for n, size in enumerate(sizes)]
        )
        for k in range(2)
    )
    matcher = EvidenceMatcher(search=SurfaceSearch(steps=4, dense=256, cells=8, free_weight=0.0))
    few = align_candidates(tiny_prior, old, new, matcher, motion)
    monkeypatch.setattr(candidates, "OBJECTS_AT_ONCE", 1)
    many = align_candidates(tiny_prior, old, new, matcher, motion)
    assert few.ready[0].whole is not None and many.ready[0].whole is None
    pairs = [tuple(row) for row in few.rows.tolist()]
    for x, y in zip(*(jax.tree.leaves((a.found, a.off, a.take(pairs))) for a in (few, many)), strict=True):
        np.testing.assert_array_equal(x, y)


def test_what_is_left_over_is_gone_unless_another_left_over_may_be_it():
    odds = np.array([[2.0, -1.0, -2.0], [-3.0, -1.0, NEVER]])
    listed = LogOdds.of(odds)
    gone, new = unmatched(listed, expit(listed.value), np.array([[0, 0]]))
    assert gone == {1: pytest.approx(1 - expit(-1.0))}
    assert new == {1: pytest.approx(1 - expit(-1.0)), 2: pytest.approx(1.0)}


def test_geometry_tells_boxes_of_one_size_but_different_shape_apart(tiny_prior):
    rng = np.random.default_rng(1)
    wide, tall = np.array([1.0, 0.5, 0.6]), np.array([0.5, 0.6, 1.0])  # the same box, on another face
    first = [box(rng, wide) + [5, 0, 0], box(rng, tall)]
    second = [box(rng, tall) + [2, 2, 0], box(rng, wide) + [0, 3, 0]]
    known = [observed(tiny_prior, clouds) for clouds in (first, second)]
    matcher = preset("robust").matching
    aligned = align_candidates(tiny_prior, known[0], known[1], matcher, "upright")
    odds = odds_of(aligned, matcher.search, "upright").matrix()
    assert odds.shape == (2, 2)
    assert min(odds[0, 1], odds[1, 0]) > max(odds[0, 0], odds[1, 1]) + 1


def test_records_of_another_encoder_are_refused_where_the_prior_has_a_say(tiny_prior):
    cloud = box(np.random.default_rng(0), np.array([1.0, 0.5, 0.6]))
    known = observed(tiny_prior, [cloud])
    with pytest.raises(ValueError, match=r"match got embeddings with 0 levels of anchors.*needed 2"):
        align_candidates(load_prior("small"), known, known, EvidenceMatcher(), "free")


# --- heights ----------------------------------------------------------------------------------------------------

ROOM = [np.array(size) for size in ([1.0, 0.5, 0.6], [0.5, 0.6, 1.0], [1.4, 0.4, 0.3])]


@pytest.fixture(scope="module")
def lifted_room(tiny_prior):
    """Three boxes, and the same again somewhere else, 6 cm lower."""
    rng = np.random.default_rng(4)
    first = [box(rng, size) + [3.0 * k, 0, 0] for k, size in enumerate(ROOM)]
    second = [box(rng, size) + [3.0 * k, 1.0, -0.06] for k, size in enumerate(ROOM)]
    return observed(tiny_prior, first), observed(tiny_prior, second)


@pytest.mark.parametrize("height_m", [0.06, 0.03])
def test_a_height_weighed_afterwards_is_that_height_searched_at(tiny_prior, lifted_room, height_m):
    matcher = preset("robust").matching
    below = align_candidates(tiny_prior, *lifted_room, matcher, "upright")
    there = align_candidates(tiny_prior, *lifted_room, matcher, "upright", vertical_shift(height_m))
    weighed = odds_of(below, matcher.search, "upright", height_m).matrix()
    searched = odds_of(there, matcher.search, "upright", height_m).matrix()
    np.testing.assert_array_equal(weighed > 0, searched > 0)
    # Boxes of different sizes fit in several poses about as badly: which of these is best may differ.
    np.testing.assert_allclose(np.diag(weighed), np.diag(searched), atol=0.3)
    assert np.abs(weighed - odds_of(below, matcher.search, "upright", 0.0).matrix()).max() > 0.3


def test_pairs_are_listed_row_by_row_and_taken_with_the_poses_found(tiny_prior, lifted_room):
    old, new = lifted_room
    matcher = EvidenceMatcher(candidates=1)
    aligned = align_candidates(tiny_prior, old, new, matcher, "upright")
    listed = [tuple(pair) for pair in aligned.rows.tolist()]
    assert listed == sorted(set(listed))
    assert aligned.rows_of(listed).tolist() == list(range(len(listed)))
    chosen = listed[::-1]
    taken = aligned.take(chosen)
    origins = [[o.points.mean(axis=0) for o in side] for side in (new, old)]
    np.testing.assert_allclose(taken.source.origin, [origins[0][i] for _, i in chosen], atol=1e-9)
    np.testing.assert_allclose(taken.target.origin, [origins[1][k] for k, _ in chosen], atol=1e-9)
    np.testing.assert_allclose(taken.to_world(taken.candidates), aligned.T_old_new[::-1], atol=1e-9)
    np.testing.assert_array_equal(taken.prepared[0].radius, aligned.ready[0].radius[aligned.rows[::-1, 1]])
