"""Matching against SciPy's assignment and rotation, a slow loop, and what permutations and padding must not change."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from more2_jax.config import CodeMatcher
from more2_jax.matching.code_assignment import (
    SMALLEST_ERROR,
    cosine,
    greedy,
    hungarian,
    match_instances,
    pair_score,
    score_matrix,
    turning_error,
)
from more2_jax.types import Embedding

ROWS, COLUMNS, CHANNELS = 8, 16, 12
# Compiled: one by one, their operations would take longer.
HUNGARIAN, GREEDY = jax.jit(hungarian), jax.jit(greedy)
scores_of, score_of = jax.jit(score_matrix, static_argnums=2), jax.jit(pair_score, static_argnums=2)
slopes_of_score = jax.jit(jax.grad(pair_score, argnums=(0, 1)), static_argnums=2)
error_of, cosine_of = jax.jit(turning_error), jax.jit(cosine)


def codes(seed, count):
    """Random embeddings of `count` objects, F_eqv of unit columns."""
    rng = np.random.default_rng(seed)
    eqv = rng.normal(size=(count, 3, CHANNELS))
    return Embedding(
        inv=jnp.asarray(rng.normal(size=(count, CHANNELS)), jnp.float32),
        eqv=jnp.asarray(eqv / np.linalg.norm(eqv, axis=1, keepdims=True), jnp.float32),
        scale=jnp.asarray(rng.uniform(0.5, 2.0, count), jnp.float32),
        center=jnp.asarray(rng.normal(size=(count, 3)), jnp.float32),
        origin=np.zeros((count, 3), np.float32),
    )


def rows(e, index):
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[np.asarray(index)]), e)


def one(e, k=0):
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[k]), e)


def with_junk(e, start, junk):
    """Junk in all rows from `start`."""
    first = lambda x: np.arange(len(x)).reshape(-1, *[1] * (x.ndim - 1)) < start  # noqa: E731
    return jax.tree.map(lambda x: jnp.asarray(np.where(first(x), x, np.float32(junk))), e)


def padded(score, junk):
    """A score matrix in the corner of a fixed size, its surroundings filled with junk that is not allowed."""
    n, m = score.shape
    full, allowed = junk.astype(np.float32).copy(), np.zeros((ROWS, COLUMNS), bool)
    full[:n, :m], allowed[:n, :m] = score, True
    return full, allowed


def total(score, index):
    return sum(score[row, column] for row, column in enumerate(index) if column >= 0)


# --- assignment -------------------------------------------------------------------------------------------------


def test_hungarian_finds_scipys_total_on_200_matrices_of_any_shape():
    rng = np.random.default_rng(0)
    for _ in range(200):
        n, m = rng.integers(1, ROWS + 1), rng.integers(1, COLUMNS + 1)
        score = rng.normal(scale=10 ** rng.uniform(-2, 2), size=(n, m)).astype(np.float32)
        full, allowed = padded(score, 1e4 * rng.normal(size=(ROWS, COLUMNS)))
        index, chosen = map(np.asarray, HUNGARIAN(full, allowed))
        expected = score[linear_sum_assignment(score, maximize=True)].sum()
        assert total(score, index[:n]) == pytest.approx(expected, abs=1e-5 * np.abs(score).max() * n)
        assert (index[:n] >= 0).sum() == min(n, m) and (index[n:] == -1).all() and (index < m).all()
        used = index[index >= 0]
        assert len(set(used)) == len(used)
        assert chosen.sum() == pytest.approx(total(score, index[:n]), rel=1e-4, abs=1e-4)


def test_hungarian_with_forbidden_pairs_matches_as_many_as_possible_then_the_best():
    rng = np.random.default_rng(1)
    for _ in range(60):
        score = rng.normal(size=(ROWS, COLUMNS)).astype(np.float32)
        allowed = rng.random((ROWS, COLUMNS)) < 0.15
        index = np.asarray(HUNGARIAN(score, allowed)[0])
        row, column = linear_sum_assignment(np.where(allowed, score, -1e3).astype(np.float64), maximize=True)
        kept = allowed[row, column]
        assert (index >= 0).sum() == kept.sum()
        assert all(allowed[k, i] for k, i in enumerate(index) if i >= 0)
        assert total(score, index) == pytest.approx(score[row[kept], column[kept]].sum(), abs=1e-4)


@pytest.mark.parametrize("assign", [HUNGARIAN, GREEDY])
def test_nothing_allowed_is_nothing_matched(assign):
    index, chosen = assign(np.ones((ROWS, COLUMNS), np.float32), np.zeros((ROWS, COLUMNS), bool))
    assert (np.asarray(index) == -1).all() and (np.asarray(chosen) == 0).all()


@pytest.mark.parametrize("assign", [HUNGARIAN, GREEDY])
def test_scores_all_alike_still_match_one_to_one(assign):
    index, _ = assign(np.full((ROWS, COLUMNS), 0.5, np.float32), np.ones((ROWS, COLUMNS), bool))
    assert (np.asarray(index) >= 0).all() and len(set(np.asarray(index).tolist())) == ROWS


def greedy_by_definition(score, allowed):
    index = np.full(len(score), -1)
    left = {(r, c) for r, c in np.ndindex(score.shape) if allowed[r, c]}
    while left:
        r, c = max(left, key=lambda pair: score[pair])
        index[r] = c
        left = {(a, b) for a, b in left if a != r and b != c}
    return index


def test_greedy_takes_the_best_pair_first():
    rng = np.random.default_rng(2)
    for _ in range(40):
        n, m = rng.integers(1, ROWS + 1), rng.integers(1, COLUMNS + 1)
        full, allowed = padded(rng.normal(size=(n, m)), 1e4 * rng.normal(size=(ROWS, COLUMNS)))
        allowed &= rng.random(allowed.shape) < 0.7
        np.testing.assert_array_equal(GREEDY(full, allowed)[0], greedy_by_definition(full, allowed))


def test_greedy_and_hungarian_differ_where_the_best_pair_is_not_in_the_best_total():
    score = np.full((ROWS, COLUMNS), -1e3, np.float32)
    allowed = np.zeros((ROWS, COLUMNS), bool)
    score[:2, :2], allowed[:2, :2] = [[1.0, 0.9], [0.9, 0.0]], True
    np.testing.assert_array_equal(np.asarray(GREEDY(score, allowed)[0])[:2], [0, 1])
    np.testing.assert_array_equal(np.asarray(HUNGARIAN(score, allowed)[0])[:2], [1, 0])


# --- the score --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["inv", "eqv", "both"])
def test_score_is_cosine_over_the_error_after_the_best_rotation(kind):
    source, target = codes(3, 5), codes(4, 6)
    got = np.asarray(scores_of(source, target, CodeMatcher(score=kind)))
    source, target = jax.device_get((source, target))
    for k in range(5):
        for i in range(6):
            a, b = (np.asarray(x, np.float64) for x in (source.inv[k], target.inv[i]))
            expected = a @ b / np.linalg.norm(a) / np.linalg.norm(b) if kind != "eqv" else 1.0
            if kind != "inv":
                u, v = (np.asarray(x, np.float64).T for x in (source.eqv[k], target.eqv[i]))
                rotation, _ = Rotation.align_vectors(v, u)
                expected /= np.linalg.norm(rotation.apply(u) - v)
            assert got[k, i] == pytest.approx(expected, rel=2e-4, abs=1e-6)


def test_a_turned_moved_object_scores_highest_possible_with_itself():
    e = one(codes(5, 1))
    turn = Rotation.random(random_state=1).as_matrix().astype(np.float32)
    moved = dataclasses.replace(
        e, eqv=jnp.asarray(turn @ np.asarray(e.eqv)), center=jnp.asarray(np.asarray(e.center) + 5)
    )
    assert float(error_of(e.eqv, moved.eqv)) < SMALLEST_ERROR
    assert float(score_of(e, moved, CodeMatcher())) == pytest.approx(1 / SMALLEST_ERROR, rel=1e-5)


def test_a_mirrored_object_is_not_the_same_object():
    e = one(codes(5, 1))
    assert float(error_of(e.eqv, np.asarray(e.eqv) * np.float32([[-1], [1], [1]]))) > 0.1


def test_a_zero_code_is_like_nothing():
    assert float(cosine_of(np.zeros(CHANNELS, np.float32), np.ones(CHANNELS, np.float32))) == 0.0


@pytest.mark.parametrize("kind", ["inv", "eqv", "both"])
@pytest.mark.parametrize("case", ["random", "same", "zero", "line"])
def test_score_has_finite_gradients_everywhere(kind, case):
    a, b = one(codes(7, 1)), one(codes(8, 1))
    if case == "same":
        b = a
    if case == "zero":
        a = dataclasses.replace(
            a, inv=jnp.asarray(np.zeros_like(a.inv)), eqv=jnp.asarray(np.zeros_like(a.eqv))
        )
    if case == "line":
        a = dataclasses.replace(a, eqv=jnp.asarray(np.asarray(a.eqv) * np.float32([[1], [0], [0]])))
    gradient = slopes_of_score(a, b, CodeMatcher(score=kind))
    assert all(bool(np.isfinite(g).all()) for g in jax.tree.leaves(gradient))


# --- match_instances --------------------------------------------------------------------------------------------


def test_permuting_the_targets_permutes_the_matching():
    source, target = codes(9, 5), codes(10, 7)
    order = np.random.default_rng(0).permutation(7)
    plain = match_instances(source, target, CodeMatcher())
    mixed = match_instances(source, rows(target, order), CodeMatcher())
    np.testing.assert_array_equal(order[np.asarray(mixed.target_index)], plain.target_index)
    np.testing.assert_allclose(mixed.score, plain.score, rtol=1e-5)


@pytest.mark.parametrize("assignment", ["hungarian", "greedy"])
@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 3), (3, 0), (1, 1), (1, 4), (4, 1)])
def test_any_number_of_objects_on_either_side(n, m, assignment):
    config = CodeMatcher(assignment=assignment)
    matches = match_instances(codes(11, n), codes(12, m), config)
    assert matches.target_index.shape == matches.score.shape == (n,)
    index, score = np.asarray(matches.target_index), np.asarray(matches.score)
    assert (index >= 0).sum() == min(n, m)
    assert np.where(index < 0, score, 0).sum() == 0.0


def test_rows_of_padding_take_no_part():
    source, target = codes(13, 6), codes(14, 8)
    real, other = np.arange(6) < 4, np.arange(8) < 3
    alone = match_instances(rows(source, range(4)), rows(target, range(3)), CodeMatcher())
    for junk in (np.nan, np.inf, 1e20):
        dirty, filth = with_junk(source, 4, junk), with_junk(target, 3, junk)
        matches = match_instances(dirty, filth, CodeMatcher(), real, other)
        np.testing.assert_array_equal(matches.target_index, [*np.asarray(alone.target_index), -1, -1])
        np.testing.assert_allclose(np.asarray(matches.score)[:4], alone.score, rtol=1e-5)


def test_a_bonus_decides_among_identical_objects():
    source, config = rows(codes(16, 1), [0, 0]), CodeMatcher(score="inv")
    for bonus, expected in (([[0, -1], [-1, 0]], [0, 1]), ([[-1, 0], [0, -1]], [1, 0])):
        matches = match_instances(source, source, config, bonus=np.array(bonus, np.float32))
        assert matches.target_index.tolist() == expected
        np.testing.assert_allclose(matches.score, 1.0, rtol=1e-5)


def test_a_bonus_of_another_shape_is_refused(unchecked):
    with pytest.raises(ValueError, match=r"shape \(2, 2\); needed \(2, 3\)"):
        match_instances(codes(0, 2), codes(1, 3), CodeMatcher(), bonus=np.zeros((2, 2), np.float32))


def test_an_object_a_kilometer_away_matches_as_well():
    source, target = codes(9, 5), codes(10, 7)
    far = dataclasses.replace(target, origin=np.asarray(target.origin) + 1000)
    plain, moved = (match_instances(source, t, CodeMatcher()) for t in (target, far))
    np.testing.assert_array_equal(plain.target_index, moved.target_index)
    np.testing.assert_array_equal(plain.score, moved.score)
