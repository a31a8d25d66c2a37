"""Farthest points, nearest neighbors, Kabsch and chamfer against NumPy and SciPy, also where they are ill-posed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from more2_jax.geometry import points as eager
from more2_jax.geometry.points import FAR
from more2_jax.types import Sampled

RNG = np.random.default_rng(0)
CLOUD = RNG.normal(size=(50, 3)).astype(np.float32)
PLANE, LINE = CLOUD * [1, 1, 0], CLOUD * [1, 0, 0]
POINT = np.zeros((50, 3))
ONES = np.ones(50, np.float32)  # weights
DEGENERATE = {"plane": PLANE, "line": LINE, "point": POINT}


# Compiled: one by one, their operations would take longer.
farthest_points, sample, thin = (
    jax.jit(eager.farthest_points, static_argnums=2),
    jax.jit(eager.sample, static_argnums=2),
    jax.jit(eager.thin, static_argnums=1),
)
nearest, nearest_index = jax.jit(eager.nearest), jax.jit(eager.nearest_index)
nearest_in_batch = jax.jit(jax.vmap(eager.nearest_index, in_axes=(0, None, None)))
trimmed, two_way_rms = jax.jit(eager.trimmed, static_argnums=1), jax.jit(eager.two_way_rms, static_argnums=2)
chamfer_distance = jax.jit(eager.chamfer_distance, static_argnames="squared")
slope_of_chamfer = jax.jit(jax.grad(eager.chamfer_distance), static_argnums=4)
kabsch, kabsch_rotation = jax.jit(eager.kabsch), jax.jit(eager.kabsch_rotation)
slope_of_kabsch = jax.jit(jax.grad(lambda *clouds: eager.kabsch(*clouds).as_matrix()[:3].sum()))
horn_matrix, dominant_eigenvector = jax.jit(eager.horn_matrix), jax.jit(eager.dominant_eigenvector)
slope_of_eigenvector = jax.jit(jax.grad(lambda matrix: eager.dominant_eigenvector(matrix).sum()))
cloud_radius, icp = jax.jit(eager.cloud_radius), jax.jit(eager.icp, static_argnums=(3, 4))
matrix_of = jax.jit(lambda T: T.as_matrix())


def every(count):
    return np.ones(count, bool)


def f32(x):
    return np.asarray(x, np.float32)


def random_pose(seed):
    rng = np.random.default_rng(seed)
    return Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3)


# --- farthest points --------------------------------------------------------------------------------------------


def farthest_by_definition(points, count):
    chosen = [0]
    while len(chosen) < count:
        chosen.append(int(cdist(points, points[chosen]).min(axis=1).argmax()))
    return points[chosen]


def test_farthest_points_by_definition():
    got, real = map(np.asarray, farthest_points(f32(CLOUD), every(50), 20))
    assert bool(real.all())
    np.testing.assert_array_equal(got, farthest_by_definition(CLOUD, 20))


def test_a_prefix_of_farthest_points_is_the_shorter_sample():
    long, _ = farthest_points(f32(CLOUD), every(50), 40)
    short, _ = farthest_points(f32(CLOUD), every(50), 10)
    np.testing.assert_array_equal(np.asarray(long)[:10], short)


def test_masked_rows_are_never_chosen_and_change_nothing():
    garbage = np.concatenate([CLOUD[:30], np.full((20, 3), 1e3)])
    mask = np.arange(50) < 30
    got, real = map(np.asarray, farthest_points(f32(garbage), mask, 30))
    alone, _ = farthest_points(f32(CLOUD[:30]), every(30), 30)
    assert bool(real.all())
    np.testing.assert_array_equal(got, alone)


def test_duplicates_are_taken_once():
    got, real = map(np.asarray, farthest_points(f32(np.tile(CLOUD[:5], (4, 1))), every(20), 12))
    assert int(real.sum()) == 5
    np.testing.assert_array_equal(np.unique(got[real], axis=0), np.unique(CLOUD[:5], axis=0))
    assert set(map(tuple, np.asarray(got))) <= set(map(tuple, CLOUD[:5]))


def test_no_points_at_all():
    got, real = map(np.asarray, farthest_points(f32(CLOUD), np.zeros(50, bool), 4))
    assert not bool(real.any())
    assert bool(np.isfinite(got).all())


# --- nearest ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "m"), [(50, 33), (7, 1), (1, 64), (30, 65), (30, 200), (40, 2048)])
def test_nearest_is_scipys_up_to_its_ties(n, m):
    a, b = RNG.normal(size=(n, 3)), RNG.normal(size=(m, 3))
    _, squared = nearest(f32(a), every(n), f32(b), every(m))
    expected = cKDTree(b).query(a)[0] ** 2
    assert (np.asarray(squared) >= expected * (1 - 1e-4) - 1e-6).all()
    assert (np.asarray(squared) <= expected * (1 + 2.0**-10) + 1e-6).all()


def test_nearest_never_chooses_a_masked_row():
    mask = np.array([True, False, True])
    b = f32([[5, 0, 0], [0, 0, 0], [-4, 0, 0]])
    index, squared = nearest(f32([[0, 0, 0]]), every(1), b, mask)
    assert (index.tolist(), squared.tolist()) == ([2], [16])


def test_nearest_skips_what_is_padding_whichever_rows_that_is():
    """Rows are compared in blocks of 64, of which some are masked in full."""
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(40, 3)), rng.normal(size=(400, 3))
    mask = np.zeros(400, bool)
    mask[70:90] = mask[300:330] = True
    for index in (nearest_index, nearest_in_batch):
        few = f32(a if index is nearest_index else a[None])
        found = np.asarray(index(few, f32(b), mask)).ravel()
        assert mask[found].all()
        away = np.linalg.norm(a - b[found], axis=1) ** 2
        least = (np.linalg.norm(a[:, None] - b[mask], axis=2) ** 2).min(axis=1)
        np.testing.assert_allclose(away, least, rtol=2**-10)


def test_of_rows_as_near_the_first_that_is_real_is_nearest():
    b, mask = np.full((200, 3), 9.0), np.ones(200, bool)
    b[[3, 70, 130, 199]], mask[3] = 1.0, False
    index = nearest_index(f32([[1, 1, 1], [2, 1, 1], [9, 9, 9]]), f32(b), mask)
    assert index.tolist() == [70, 70, 0]


def test_nearest_of_what_is_not_there_is_far():
    squared = np.asarray(nearest(f32(CLOUD), np.arange(50) < 3, f32(CLOUD), every(50))[1])
    np.testing.assert_array_equal(squared[:3], 0)
    np.testing.assert_array_equal(squared[3:], np.float32(FAR))
    _, squared = nearest(f32(CLOUD), every(50), f32(CLOUD), np.zeros(50, bool))
    np.testing.assert_array_equal(squared, np.float32(FAR))


# --- trimming and residuals -------------------------------------------------------------------------------------


def test_trimmed_keeps_the_smallest_share_of_what_is_real():
    squared = f32([4, FAR, 1, 3, 2, FAR])
    assert np.flatnonzero(trimmed(squared, 1.0)).tolist() == [0, 2, 3, 4]
    assert np.flatnonzero(trimmed(squared, 0.5)).tolist() == [2, 4]
    assert np.flatnonzero(trimmed(squared, 0.51)).tolist() == [2, 3, 4]
    assert not np.asarray(trimmed(f32([FAR, FAR]), 0.7)).any()


def test_two_way_rms_by_definition():
    a, b = RNG.normal(size=(20, 3)), RNG.normal(size=(31, 3))
    one, other = (sample(f32(x), every(len(x)), len(x)) for x in (a, b))
    distances = cdist(a, b)
    ways = [np.sqrt(np.mean(distances.min(axis=k) ** 2)) for k in (0, 1)]
    assert float(two_way_rms(one, other, 1.0)) == pytest.approx(np.mean(ways), rel=1e-3)
    assert float(two_way_rms(one, one, 1.0)) == pytest.approx(0, abs=1e-6)
    assert float(two_way_rms(one, other, 0.5)) < np.mean(ways)


def test_a_sample_stands_beside_nothing_more():
    few = sample(f32(CLOUD), every(50), 10)
    assert isinstance(few, Sampled)
    np.testing.assert_array_equal(few.points, farthest_points(f32(CLOUD), every(50), 10)[0])
    np.testing.assert_array_equal(few.points, few.dense)


def test_thinning_takes_the_real_rows_evenly_and_all_where_there_are_fewer():
    mask = np.arange(50) % 2 == 1
    index, real = map(np.asarray, thin(mask, 5))
    np.testing.assert_array_equal(index, np.arange(50)[mask][::5])
    assert bool(real.all())
    index, real = map(np.asarray, thin(mask, 40))
    np.testing.assert_array_equal(index[real], np.arange(50)[mask])
    assert int(real.sum()) == 25


def test_chamfer_by_definition_and_blind_to_padding():
    a, b = RNG.normal(size=(20, 3)), RNG.normal(size=(31, 3))
    distances = cdist(a, b)
    expected = distances.min(axis=1).mean() + distances.min(axis=0).mean()
    assert float(chamfer_distance(f32(a), every(20), f32(b), every(31))) == pytest.approx(expected, rel=1e-3)
    padded = np.concatenate([a, np.full((12, 3), 77.0)])
    again = chamfer_distance(f32(padded), np.arange(32) < 20, f32(b), every(31))
    assert float(again) == pytest.approx(expected, rel=1e-3)
    assert float(chamfer_distance(f32(a), every(20), f32(a), every(20))) == pytest.approx(0, abs=1e-6)
    of_squares = (distances.min(axis=1) ** 2).mean() + (distances.min(axis=0) ** 2).mean()
    found = chamfer_distance(f32(padded), np.arange(32) < 20, f32(b), every(31), squared=True)
    assert float(found) == pytest.approx(of_squares, rel=1e-3)


def test_chamfer_has_a_finite_gradient_at_coincidence():
    for squared in (False, True):
        gradient = slope_of_chamfer(f32(CLOUD), every(50), f32(CLOUD), every(50), squared)
        assert bool(np.isfinite(gradient).all())


# --- Kabsch -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(8))
def test_kabsch_recovers_a_rigid_motion(seed):
    R, t = random_pose(seed)
    T = np.asarray(matrix_of(kabsch(f32(CLOUD), f32(CLOUD @ R.T + t), ONES)))
    np.testing.assert_allclose(T[:3, :3], R, atol=1e-5)
    np.testing.assert_allclose(T[:3, 3], t, atol=1e-5)


@pytest.mark.parametrize("seed", range(8))
def test_kabsch_is_scipys_with_weights_and_noise(seed):
    rng = np.random.default_rng(seed)
    R, _ = random_pose(seed)
    target, weight = CLOUD @ R.T + rng.normal(0, 0.3, CLOUD.shape), rng.uniform(size=50)
    expected, _ = Rotation.align_vectors(target, CLOUD, weight)
    got = kabsch_rotation(f32(CLOUD), f32(target), f32(weight))
    np.testing.assert_allclose(matrix_of(got), expected.as_matrix(), atol=2e-4)


def test_weight_zero_leaves_a_row_out():
    R, t = random_pose(3)
    target = CLOUD @ R.T + t
    target[:5] += 100
    T = kabsch(f32(CLOUD), f32(target), f32(np.arange(50) >= 5))
    np.testing.assert_allclose(np.asarray(matrix_of(T))[:3, :3], R, atol=1e-5)


def test_a_reflection_is_answered_by_the_best_rotation():
    mirrored = CLOUD * [1, 1, -1]
    got = np.asarray(matrix_of(kabsch_rotation(f32(CLOUD), f32(mirrored))))
    assert np.linalg.det(got) == pytest.approx(1, abs=1e-5)
    expected, _ = Rotation.align_vectors(mirrored, CLOUD)
    np.testing.assert_allclose(got, expected.as_matrix(), atol=1e-3)


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_clouds_still_give_a_rotation_that_fits(name):
    cloud = DEGENERATE[name]
    R, t = random_pose(5)
    T = np.asarray(matrix_of(kabsch(f32(cloud), f32(cloud @ R.T + t), ONES)))
    matrix = T[:3, :3]
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-5)
    assert np.linalg.det(matrix) == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose(cloud @ matrix.T + T[:3, 3], cloud @ R.T + t, atol=1e-4)


def test_no_weight_at_all_is_no_motion():
    T = kabsch(f32(CLOUD), f32(CLOUD + 3), np.zeros(50, np.float32))
    np.testing.assert_allclose(matrix_of(T), np.eye(4), atol=1e-6)


@pytest.mark.parametrize("cloud", [CLOUD, *DEGENERATE.values()], ids=["cloud", *DEGENERATE])
def test_the_gradient_of_kabsch_is_finite(cloud):
    R, t = random_pose(6)
    target = f32(cloud @ R.T + t)
    for source, goal in (
        (f32(cloud), target),
        (f32(cloud), f32(cloud)),
        (f32(cloud), f32(cloud * [1, 1, -1])),
    ):
        gradient = slope_of_kabsch(source, goal, ONES)
        assert bool(np.isfinite(gradient).all())


@jax.jit
@jax.value_and_grad
def loss_and_slope(x, target):
    return jnp.sin(3 * eager.kabsch(x, target, jnp.ones(8)).as_matrix()).sum()


def test_the_gradient_of_kabsch_is_the_finite_difference():
    target = CLOUD[:8] @ random_pose(7)[0].T + 0.1 * RNG.normal(size=(8, 3))
    with jax.enable_x64(True):
        x, direction = np.asarray(CLOUD[:8], np.float64), RNG.normal(size=(8, 3))
        slope = float(np.sum(loss_and_slope(x, target)[1] * direction))
        step = 1e-5
        after, before = (float(loss_and_slope(x + s * direction, target)[0]) for s in (step, -step))
        difference = (after - before) / (2 * step)
    assert slope == pytest.approx(difference, rel=1e-5)


# --- eigenvectors and axes --------------------------------------------------------------------------------------


def test_dominant_eigenvector_is_numpys():
    for seed in range(20):
        a = np.random.default_rng(seed).normal(size=(4, 4))
        a = (a + a.T) / 2
        values, vectors = np.linalg.eigh(a)
        if values[3] - values[2] > 0.1:
            got = np.asarray(dominant_eigenvector(f32(a)))
            assert abs(got @ vectors[:, 3]) == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize(
    "matrix",
    [np.zeros((4, 4)), np.eye(4), -np.eye(4), np.diag([2.0, 2, -1, -3])],
    ids=["0", "1", "-1", "pair"],
)
def test_a_repeated_eigenvalue_gives_a_unit_vector_of_its_space(matrix):
    got = np.asarray(dominant_eigenvector(f32(matrix)))
    assert np.linalg.norm(got) == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose(matrix @ got, np.linalg.eigvalsh(matrix)[-1] * got, atol=1e-4)
    assert bool(np.isfinite(slope_of_eigenvector(f32(matrix))).all())


def test_horns_matrix_has_no_trace_and_knows_the_identity():
    h = f32(CLOUD.T @ CLOUD)
    matrix = np.asarray(horn_matrix(h))
    np.testing.assert_allclose(matrix, matrix.T)
    assert np.trace(matrix) == pytest.approx(0, abs=1e-3)
    np.testing.assert_allclose(np.abs(dominant_eigenvector(matrix)), [1, 0, 0, 0], atol=1e-5)


def test_radius():
    assert float(cloud_radius(f32([[1, 0, 0], [-1, 0, 0], [9, 9, 9]]), np.array([True, True, False]))) == 1
    assert float(cloud_radius(f32([[7, 7, 7]]), every(1))) == pytest.approx(1e-6)


# --- ICP --------------------------------------------------------------------------------------------------------


def test_icp_walks_home_from_nearby():
    R = Rotation.from_rotvec([0.05, -0.1, 0.08]).as_matrix()
    stretched = CLOUD * [1, 3, 2]
    source = sample(f32(stretched), every(50), 50)
    target = sample(f32(stretched @ R.T + 0.05), every(50), 50)
    T = np.asarray(matrix_of(icp(kabsch(f32(CLOUD), f32(CLOUD), ONES), source, target, 1.0, 20)))
    np.testing.assert_allclose(T[:3, :3], R, atol=1e-3)
    np.testing.assert_allclose(T[:3, 3], np.full(3, 0.05), atol=1e-3)
