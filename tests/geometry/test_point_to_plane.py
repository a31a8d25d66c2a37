"""Surface alignment: normals against planes, steps against displacements, the covariance against repeated noise."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from more2_jax.geometry.point_to_plane import (
    align,
    correspondences,
    least_axis,
    moments,
    pose_covariance,
    sliding,
    solve_spd,
    surrounded,
    thinned,
    whole_surface,
)
from more2_jax.geometry.points import transformed
from more2_jax.registration.pose_costs import misfit, turned_apart
from more2_jax.registration.surface import TURNED_DEG, choose, nearly_as_good

POINTS = 256


def box_points(rng, size=(1.0, 0.6, 0.4), count=POINTS):
    """Points on three faces of a box that meet in a corner: no symmetry, and their normals' axes."""
    axis = rng.integers(0, 3, count)
    points = rng.uniform(-0.5, 0.5, (count, 3))
    points[np.arange(count), axis] = 0.5
    return (points * size).astype(np.float32), axis


def as_surface(points, mask=None, outward=None):
    mask = np.ones(len(points), bool) if mask is None else mask
    outward = None if outward is None else jnp.asarray(outward, jnp.float32)
    return whole_surface(jnp.asarray(points, jnp.float32), jnp.asarray(mask), outward)


aligned = jax.jit(align, static_argnames=("reach", "steps", "motion"))
covariance_of = jax.jit(pose_covariance, static_argnames=("reach", "motion"))


def test_normals_of_flat_faces_are_their_axes():
    points, axis = box_points(np.random.default_rng(0), count=1024)
    normals = np.asarray(as_surface(points).dense_normals)
    inside = (np.sort(0.5 - np.abs(points) / [1.0, 0.6, 0.4], axis=1)[:, 1]) > 0.2  # away from the edges
    assert inside.sum() > 100
    along = np.abs(normals[np.arange(len(points)), axis])[inside]
    assert along.min() > 0.99
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-4)


def test_least_axis_is_that_of_numpy():
    rng = np.random.default_rng(6)
    factors = rng.normal(size=(200, 3, 3)) * 10.0 ** rng.uniform(-4, 1, (200, 1, 1)) * [1.0, 0.5, 0.1]
    matrices = factors @ np.swapaxes(factors, 1, 2)
    matrices = np.concatenate([matrices, [np.diag([4.0, 1, 0]), np.diag([0, 1.0, 1])]])
    values, vectors = np.linalg.eigh(matrices)
    clear = values[:, 1] - values[:, 0] > 0.02 * values[:, 2]
    got = np.asarray(least_axis(jnp.asarray(matrices, jnp.float32)))
    assert clear.sum() > 100
    assert np.abs(np.sum(got * vectors[..., 0], axis=1))[clear].min() > 0.999
    for degenerate in (np.zeros((3, 3)), np.eye(3), np.diag([1.0, 0, 0])):
        axis = np.asarray(least_axis(jnp.asarray(degenerate, jnp.float32)))
        assert np.isfinite(axis).all() and np.linalg.norm(axis) == pytest.approx(1, abs=1e-4)
    lines = rng.normal(size=(100, 3))
    lines /= np.linalg.norm(lines, axis=1, keepdims=True)
    axes = np.asarray(least_axis(jnp.asarray(lines[:, :, None] * lines[:, None], jnp.float32)))
    assert np.abs(np.sum(axes * lines, axis=1)).max() < 1e-3  # of what lies along a line: across it


@pytest.mark.parametrize(
    ("size", "least"), [(6, 0.1), (42, 42.0), (186, 186.0)]
)  # of one pose, and of graphs
def test_elimination_solves_what_numpy_solves(size, least):
    rng = np.random.default_rng(7)
    A = rng.normal(size=(size, size))
    A, b = A @ A.T + least * np.eye(size), rng.normal(size=(size, 2))
    np.testing.assert_allclose(solve_spd(jnp.asarray(A), jnp.asarray(b)), np.linalg.solve(A, b), rtol=2e-3)


def test_sums_of_moments_are_the_normal_equations_of_moved_points():
    rng = np.random.default_rng(1)
    points, gap = (jnp.asarray(rng.normal(size=(3, 5)), jnp.float32) for _ in range(2))
    weight = jnp.asarray(rng.uniform(size=5), jnp.float32)
    J = jax.jacobian(lambda xi: jaxlie.SE3.exp(xi) @ points.T)(jnp.zeros(6))
    matrix, vector = sliding(moments(jnp.concatenate([points, gap, jnp.ones((1, 5))]), weight))
    np.testing.assert_allclose(matrix, jnp.einsum("n,nik,nil->kl", weight, J, J), atol=1e-5)
    np.testing.assert_allclose(vector, jnp.einsum("n,nik,in->k", weight, J, gap), atol=1e-5)


@pytest.mark.parametrize("degrees", [0.0, 1e-4, 179.9, 180.0])
def test_points_are_moved_as_jaxlie_moves_them(degrees):
    rng = np.random.default_rng(2)
    axis = rng.normal(size=3)
    turn = jaxlie.SO3.exp(jnp.asarray(np.deg2rad(degrees) * axis / np.linalg.norm(axis), jnp.float32))
    T = jaxlie.SE3.from_rotation_and_translation(turn, jnp.asarray(rng.normal(size=3), jnp.float32))
    points = jnp.asarray(rng.normal(size=(9, 3)), jnp.float32)
    np.testing.assert_allclose(transformed(T, points), T @ points, atol=1e-6)


@pytest.mark.parametrize("degrees", [0.0, 33.0, 180.0])
def test_what_corresponds_is_what_a_search_tree_finds_nearest(degrees):
    rng = np.random.default_rng(4)
    a, b = (as_surface(box_points(rng, count=n)[0]) for n in (200, 90))
    R, shift = Rotation.from_euler("zx", [degrees, 2], degrees=True), np.array([0.1, -0.05, 0.02])
    turn = jaxlie.SO3.from_matrix(jnp.asarray(R.as_matrix(), jnp.float32))
    T = jaxlie.SE3.from_rotation_and_translation(turn, jnp.asarray(shift, jnp.float32))
    c = jax.jit(correspondences)(T, a, b)
    moved, other = R.apply(np.asarray(a.sampled.points)) + shift, np.asarray(b.sampled.points)
    distances = [KDTree(y).query(x)[0] for x, y in ((moved, other), (other, moved))]
    np.testing.assert_allclose(np.sqrt(c.squared), np.concatenate(distances), atol=2e-3)
    # Whose normals they are: those of the points they stand beside.
    for cloud, normals, points, at in (
        (moved, R.apply(np.asarray(a.normals)), c.source, c.source_normal),
        (other, np.asarray(b.normals), c.target, c.target_normal),
    ):
        off, row = KDTree(cloud).query(np.asarray(points).T)
        assert off.max() < 1e-5
        np.testing.assert_allclose(np.asarray(at).T, normals[row], atol=1e-5)


@pytest.mark.parametrize("motion", ["free", "upright"])
def test_alignment_recovers_a_displacement_and_upright_never_tilts(motion):
    points, _ = box_points(np.random.default_rng(2))
    turn = Rotation.from_euler("z", 12, degrees=True)
    if motion == "free":
        turn = Rotation.from_rotvec(np.deg2rad(12) * np.array([0.6, 0, 0.8]))
    moved = turn.apply(points) + [0.03, -0.02, 0.04]
    T = aligned(jaxlie.SE3.identity(), as_surface(points), as_surface(moved), (0.15, 0.02), 25, motion)
    R = np.asarray(T.rotation().as_matrix())
    assert np.rad2deg(np.arccos(min(1, (np.trace(R @ turn.as_matrix().T) - 1) / 2))) < 0.5
    assert np.abs(np.asarray(T.translation()) - [0.03, -0.02, 0.04]).max() < 0.005
    if motion == "upright":
        np.testing.assert_allclose(R[2], [0, 0, 1], atol=1e-6)


def test_normals_take_the_side_that_the_scan_says_and_have_none_where_it_does_not():
    points, axis = box_points(np.random.default_rng(0))
    outward = np.eye(3)[axis]
    for sign in (1, -1):
        given = sign * outward * (np.arange(len(points)) % 3 > 0)[:, None]  # of every third point not known
        s = as_surface(points, outward=given)
        sided, along = np.asarray(s.sided), np.sum(np.asarray(s.normals) * given, axis=1)
        assert (along >= 0).all() and not sided[::3].any()
        assert sided[np.arange(len(points)) % 3 > 0].mean() > 0.9
    across = np.eye(3)[(axis + 1) % 3]  # along the surface: says nothing of its sides
    assert np.asarray(as_surface(points, outward=across).sided).mean() < 0.3


def plate(rng, height, up):
    points = np.c_[rng.uniform(-0.5, 0.5, (POINTS, 2)), np.full(POINTS, height)]
    return as_surface(points, outward=np.tile([0.0, 0.0, 1.0 if up else -1.0], (POINTS, 1)))


@pytest.mark.parametrize(("up", "pulled"), [(True, True), (False, False)])
def test_a_front_is_not_drawn_onto_a_back(up, pulled):
    rng = np.random.default_rng(4)
    front, other = plate(rng, 0.0, True), plate(rng, 0.05, up)
    T = aligned(jaxlie.SE3.identity(), front, other, (0.15, 0.02), 25, "free")
    assert float(T.translation()[2]) == pytest.approx(0.05 if pulled else 0.0, abs=1e-3)
    without = dataclasses.replace(front, sided=None, dense_sided=None)
    for pair in ((without, other), (other, without)):  # one side alone tells nothing
        T = aligned(jaxlie.SE3.identity(), *pair, (0.15, 0.02), 25, "free")
        assert abs(float(T.translation()[2])) == pytest.approx(0.05, abs=1e-3)


def test_normals_of_no_known_side_change_nothing():
    points, _ = box_points(np.random.default_rng(2))
    moved = Rotation.from_euler("z", 12, degrees=True).apply(points) + [0.03, -0.02, 0.04]
    bare, silent = (
        aligned(jaxlie.SE3.identity(), *pair, (0.15, 0.02), 25, "free").wxyz_xyz
        for pair in (
            (as_surface(points), as_surface(moved)),
            (
                as_surface(points, outward=np.zeros_like(points)),
                as_surface(moved, outward=np.zeros_like(points)),
            ),
        )
    )
    np.testing.assert_allclose(bare, silent, atol=1e-6)


def test_degenerate_clouds_give_finite_poses():
    rng = np.random.default_rng(3)
    flat = np.c_[rng.normal(size=(64, 2)), np.zeros(64)]
    line = np.c_[rng.normal(size=64), np.zeros((64, 2))]
    one = np.zeros((64, 3))
    for points in (flat, line, one):
        s = as_surface(points)
        T = aligned(jaxlie.SE3.identity(), s, s, (0.15, 0.02), 25, "free")
        assert np.isfinite(np.asarray(T.wxyz_xyz)).all()
        assert np.isfinite(np.asarray(covariance_of(T, s, s, 0.05, "free"))).all()


def test_covariance_is_the_spread_over_repeated_noise_up_to_a_small_factor():
    rng = np.random.default_rng(4)
    points, _ = box_points(rng)
    target, noise, ends, said = as_surface(points), 0.004, [], []
    for _ in range(12):
        source = as_surface(points + rng.normal(0, noise, points.shape))
        T = aligned(jaxlie.SE3.identity(), source, target, (0.15, 0.05), 15, "free")
        ends.append(np.asarray(T.log()))
        said.append(np.sqrt(np.diagonal(np.asarray(covariance_of(T, source, target, 0.05, "free")))))
    ratio = np.std(ends, axis=0) / np.mean(said, axis=0)
    assert (ratio > 0.2).all() and (ratio < 5).all()


def test_misfit_is_0_of_a_cloud_with_itself_and_1_far_away():
    s = as_surface(box_points(np.random.default_rng(5))[0])
    far = jaxlie.SE3.from_translation(jnp.array([10.0, 0, 0]))
    assert float(misfit(jaxlie.SE3.identity(), s, s, (0.1,))) < 1e-4
    assert float(misfit(far, s, s, (0.1,))) == pytest.approx(1)
    lost = jaxlie.SE3(jnp.full(7, jnp.nan))
    assert float(misfit(lost, s, s, (0.1,))) == 1


def test_it_stayed_wins_when_as_good_and_loses_when_worse():
    assert int(choose(jnp.array([0.2, 0.21]), stayed_is_last=True)) == 1
    assert int(choose(jnp.array([0.2, 0.5]), stayed_is_last=True)) == 0
    assert int(choose(jnp.array([0.2, 0.21]), stayed_is_last=False)) == 0


def test_poses_compete_that_are_turned_otherwise_and_nearly_as_good():
    turns = jnp.deg2rad(jnp.array([0.0, 3, 180, 180]))
    poses = jaxlie.SE3.from_rotation(jax.vmap(jaxlie.SO3.from_z_radians)(turns))
    costs, best = jnp.array([0.1, 0.1, 0.105, 0.4]), jnp.array(0)
    assert turned_apart(poses, best, TURNED_DEG).tolist() == [False, False, True, True]
    assert nearly_as_good(costs, best).tolist() == [True, True, True, False]


def amid(points, rest, real=None):
    """A cloud amid other points of its scan."""
    mask = np.ones(len(rest), bool) if real is None else real
    return surrounded(as_surface(points), jnp.asarray(rest, jnp.float32), jnp.asarray(mask))


@pytest.mark.slow
def test_a_whole_fits_a_half_whose_rest_lies_around_it():
    """A mask that is cut: at the true pose nothing is amiss, and alignment does not slide the whole onto the half."""
    points, _ = box_points(np.random.default_rng(8), (1.6, 0.5, 0.4), 768)
    left = points[:, 0] < 0.1
    alone, whole = as_surface(points[left]), thinned(as_surface(points), 128)
    surroundings = amid(points[left], points[~left])
    fit = jax.jit(lambda T, s: misfit(T, whole, thinned(s, 128), (0.2,)))
    assert fit(jaxlie.SE3.identity(), surroundings) < 0.02 < 0.15 < fit(jaxlie.SE3.identity(), alone)
    start = jaxlie.SE3.from_translation(jnp.array([-0.25, 0.0, 0.0]))
    off = [
        np.linalg.norm(aligned(start, whole, thinned(s, 128), (0.3, 0.03), 30, "upright").translation())
        for s in (surroundings, alone)
    ]
    assert off[0] < 0.01 and off[1] > 0.1


def test_only_own_points_are_compared_and_what_is_masked_is_not_there():
    rng = np.random.default_rng(9)
    (points, _), (rest, _) = box_points(rng), box_points(rng)
    own = thinned(amid(points, rest + 0.1), 64).sampled
    assert np.isin(np.asarray(own.points[own.mask]), points).all() and own.mask.all()
    nothing = amid(points, np.full_like(rest, 7.0), np.zeros(len(rest), bool))
    other = thinned(as_surface(rest), 64)
    T = jaxlie.SE3.from_translation(jnp.array([0.05, 0.0, 0.1]))
    for limit in (0.05, 0.3):
        there, without = (misfit(T, other, thinned(s, 64), (limit,)) for s in (nothing, as_surface(points)))
        np.testing.assert_allclose(there, without, atol=1e-6)


def test_what_lies_around_has_no_side():
    points, axis = box_points(np.random.default_rng(10))
    outward = np.eye(3)[axis]
    s = surrounded(as_surface(points, outward=outward), jnp.asarray(points[:50] + 0.3), jnp.ones(50, bool))
    assert s.dense_sided[: len(points)].mean() > 0.9 and not s.dense_sided[len(points) :].any()
    assert as_surface(points).sided is None and amid(points, points[:50]).dense_sided is None
