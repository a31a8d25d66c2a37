"""Surface alignment: normals against planes, steps against displacements, the covariance against repeated noise."""

import dataclasses

import jax
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
STAY = jaxlie.SE3(np.array([1, 0, 0, 0, 0, 0, 0], np.float32))
# Compiled: one by one, their operations would take longer.
surface_of, surrounded_by = jax.jit(whole_surface), jax.jit(surrounded)
thinned_to = jax.jit(thinned, static_argnums=1)
aligned = jax.jit(align, static_argnames=("reach", "steps", "motion"))
covariance_of = jax.jit(pose_covariance, static_argnames=("reach", "motion"))
corresponding, misfit_at = jax.jit(correspondences), jax.jit(misfit, static_argnums=3)
moved_by_jaxlie = jax.jit(lambda T, points: T @ points)
axis_of, solved, moved_by = jax.jit(least_axis), jax.jit(solve_spd), jax.jit(transformed)
chosen, as_good = jax.jit(choose, static_argnames="stayed_is_last"), jax.jit(nearly_as_good)
apart = jax.jit(turned_apart, static_argnums=2)
summed = jax.jit(lambda rows, weight: sliding(moments(rows, weight)))
slopes_of_moved = jax.jit(jax.jacobian(lambda xi, points: jaxlie.SE3.exp(xi) @ points.T))


def shifted(shift):
    """The pose that shifts by so much and does not turn."""
    return jaxlie.SE3(np.array([1, 0, 0, 0, *shift], np.float32))


def posed(R, shift):
    """The pose of a rotation of SciPy and a shift."""
    return jaxlie.SE3(np.concatenate([R.as_quat(scalar_first=True), shift], axis=-1).astype(np.float32))


def box_points(rng, size=(1.0, 0.6, 0.4), count=POINTS):
    """Points on three faces of a box that meet in a corner: no symmetry, and their normals' axes."""
    axis = rng.integers(0, 3, count)
    points = rng.uniform(-0.5, 0.5, (count, 3))
    points[np.arange(count), axis] = 0.5
    return (points * size).astype(np.float32), axis


def as_surface(points, mask=None, outward=None):
    mask = np.ones(len(points), bool) if mask is None else mask
    outward = None if outward is None else np.asarray(outward, np.float32)
    return surface_of(np.asarray(points, np.float32), mask, outward)


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
    got = np.asarray(axis_of(np.asarray(matrices, np.float32)))
    assert clear.sum() > 100
    assert np.abs(np.sum(got * vectors[..., 0], axis=1))[clear].min() > 0.999
    for degenerate in (np.zeros((3, 3)), np.eye(3), np.diag([1.0, 0, 0])):
        axis = np.asarray(axis_of(np.asarray(degenerate, np.float32)))
        assert np.isfinite(axis).all() and np.linalg.norm(axis) == pytest.approx(1, abs=1e-4)
    lines = rng.normal(size=(100, 3))
    lines /= np.linalg.norm(lines, axis=1, keepdims=True)
    axes = np.asarray(axis_of(np.asarray(lines[:, :, None] * lines[:, None], np.float32)))
    assert np.abs(np.sum(axes * lines, axis=1)).max() < 1e-3  # of what lies along a line: across it


@pytest.mark.parametrize(
    ("size", "least"), [(6, 0.1), (42, 42.0), (186, 186.0)]
)  # of one pose, and of graphs
def test_elimination_solves_what_numpy_solves(size, least):
    rng = np.random.default_rng(7)
    A = rng.normal(size=(size, size))
    A, b = A @ A.T + least * np.eye(size), rng.normal(size=(size, 2))
    np.testing.assert_allclose(solved(A, b), np.linalg.solve(A, b), rtol=2e-3)


def test_sums_of_moments_are_the_normal_equations_of_moved_points():
    rng = np.random.default_rng(1)
    points, gap = (rng.normal(size=(3, 5)).astype(np.float32) for _ in range(2))
    weight = rng.uniform(size=5).astype(np.float32)
    J = np.asarray(slopes_of_moved(np.zeros(6, np.float32), points))
    matrix, vector = summed(np.concatenate([points, gap, np.ones((1, 5), np.float32)]), weight)
    np.testing.assert_allclose(matrix, np.einsum("n,nik,nil->kl", weight, J, J), atol=1e-5)
    np.testing.assert_allclose(vector, np.einsum("n,nik,in->k", weight, J, gap), atol=1e-5)


@pytest.mark.parametrize("degrees", [0.0, 1e-4, 179.9, 180.0])
def test_points_are_moved_as_jaxlie_moves_them(degrees):
    rng = np.random.default_rng(2)
    axis = rng.normal(size=3)
    T = posed(Rotation.from_rotvec(np.deg2rad(degrees) * axis / np.linalg.norm(axis)), rng.normal(size=3))
    points = rng.normal(size=(9, 3)).astype(np.float32)
    np.testing.assert_allclose(moved_by(T, points), moved_by_jaxlie(T, points), atol=1e-6)


@pytest.mark.parametrize("degrees", [0.0, 33.0, 180.0])
def test_what_corresponds_is_what_a_search_tree_finds_nearest(degrees):
    rng = np.random.default_rng(4)
    a, b = (as_surface(box_points(rng, count=n)[0]) for n in (200, 90))
    R, shift = Rotation.from_euler("zx", [degrees, 2], degrees=True), np.array([0.1, -0.05, 0.02])
    T = posed(R, shift)
    c = corresponding(T, a, b)
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
    T = aligned(STAY, as_surface(points), as_surface(moved), (0.15, 0.02), 25, motion)
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
    T = aligned(STAY, front, other, (0.15, 0.02), 25, "free")
    assert float(T.translation()[2]) == pytest.approx(0.05 if pulled else 0.0, abs=1e-3)
    without = dataclasses.replace(front, sided=None, dense_sided=None)
    for pair in ((without, other), (other, without)):  # one side alone tells nothing
        T = aligned(STAY, *pair, (0.15, 0.02), 25, "free")
        assert abs(float(T.translation()[2])) == pytest.approx(0.05, abs=1e-3)


def test_normals_of_no_known_side_change_nothing():
    points, _ = box_points(np.random.default_rng(2))
    moved = Rotation.from_euler("z", 12, degrees=True).apply(points) + [0.03, -0.02, 0.04]
    bare, silent = (
        aligned(STAY, *pair, (0.15, 0.02), 25, "free").wxyz_xyz
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
    flat = np.c_[rng.normal(size=(POINTS, 2)), np.zeros(POINTS)]
    line = np.c_[rng.normal(size=POINTS), np.zeros((POINTS, 2))]
    one = np.zeros((POINTS, 3))
    for points in (flat, line, one):
        s = as_surface(points)
        T = aligned(STAY, s, s, (0.15, 0.02), 25, "free")
        assert np.isfinite(np.asarray(T.wxyz_xyz)).all()
        assert np.isfinite(np.asarray(covariance_of(T, s, s, 0.05, "free"))).all()


def test_covariance_is_the_spread_over_repeated_noise_up_to_a_small_factor():
    rng = np.random.default_rng(4)
    points, _ = box_points(rng)
    target, noise, ends, said = as_surface(points), 0.004, [], []
    for _ in range(12):
        source = as_surface(points + rng.normal(0, noise, points.shape))
        T = aligned(STAY, source, target, (0.15, 0.05), 15, "free")
        ends.append(np.asarray(T.log()))
        said.append(np.sqrt(np.diagonal(np.asarray(covariance_of(T, source, target, 0.05, "free")))))
    ratio = np.std(ends, axis=0) / np.mean(said, axis=0)
    assert (ratio > 0.2).all() and (ratio < 5).all()


def test_misfit_is_0_of_a_cloud_with_itself_and_1_far_away():
    s = as_surface(box_points(np.random.default_rng(5))[0])
    far = shifted([10, 0, 0])
    assert float(misfit_at(STAY, s, s, (0.1,))) < 1e-4
    assert float(misfit_at(far, s, s, (0.1,))) == pytest.approx(1)
    lost = jaxlie.SE3(np.full(7, np.nan, np.float32))
    assert float(misfit_at(lost, s, s, (0.1,))) == 1


def test_it_stayed_wins_when_as_good_and_loses_when_worse():
    assert int(chosen(np.array([0.2, 0.21], np.float32), stayed_is_last=True)) == 1
    assert int(chosen(np.array([0.2, 0.5], np.float32), stayed_is_last=True)) == 0
    assert int(chosen(np.array([0.2, 0.21], np.float32), stayed_is_last=False)) == 0


def test_poses_compete_that_are_turned_otherwise_and_nearly_as_good():
    poses = posed(Rotation.from_euler("z", [[0], [3], [180], [180]], degrees=True), np.zeros((4, 3)))
    costs, best = np.array([0.1, 0.1, 0.105, 0.4], np.float32), np.array(0)
    assert apart(poses, best, TURNED_DEG).tolist() == [False, False, True, True]
    assert as_good(costs, best).tolist() == [True, True, True, False]


def amid(points, rest, real=None):
    """A cloud amid other points of its scan."""
    mask = np.ones(len(rest), bool) if real is None else real
    return surrounded_by(as_surface(points), np.asarray(rest, np.float32), mask)


@pytest.mark.slow
def test_a_whole_fits_a_half_whose_rest_lies_around_it():
    """A mask that is cut: at the true pose nothing is amiss, and alignment does not slide the whole onto the half."""
    points, _ = box_points(np.random.default_rng(8), (1.6, 0.5, 0.4), 768)
    left = points[:, 0] < 0.1
    alone, whole = as_surface(points[left]), thinned(as_surface(points), 128)
    surroundings = amid(points[left], points[~left])
    fit = jax.jit(lambda T, s: misfit(T, whole, thinned(s, 128), (0.2,)))
    assert fit(STAY, surroundings) < 0.02 < 0.15 < fit(STAY, alone)
    start = shifted([-0.25, 0, 0])
    off = [
        np.linalg.norm(aligned(start, whole, thinned(s, 128), (0.3, 0.03), 30, "upright").translation())
        for s in (surroundings, alone)
    ]
    assert off[0] < 0.01 and off[1] > 0.1


def test_only_own_points_are_compared_and_what_is_masked_is_not_there():
    rng = np.random.default_rng(9)
    (points, _), (rest, _) = box_points(rng), box_points(rng)
    own = thinned_to(amid(points, rest + 0.1), 64).sampled
    points_there, there = np.asarray(own.points), np.asarray(own.mask)
    assert np.isin(points_there[there], points).all() and there.all()
    nothing = amid(points, np.full_like(rest, 7.0), np.zeros(len(rest), bool))
    other = thinned_to(as_surface(rest), 64)
    T = shifted([0.05, 0, 0.1])
    for limit in (0.05, 0.3):
        there, without = (
            misfit_at(T, other, thinned_to(s, 64), (limit,)) for s in (nothing, as_surface(points))
        )
        np.testing.assert_allclose(there, without, atol=1e-6)


def test_what_lies_around_has_no_side():
    points, axis = box_points(np.random.default_rng(10))
    outward = np.eye(3)[axis]
    s = surrounded_by(as_surface(points, outward=outward), points[:50] + 0.3, np.ones(50, bool))
    sided = np.asarray(s.dense_sided)
    assert sided[: len(points)].mean() > 0.9 and not sided[len(points) :].any()
    assert as_surface(points).sided is None and amid(points, points[:50]).dense_sided is None
