"""What was seen: the surface runs through it, the rest stays the field's; nothing depends on the frame."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from more2_jax.config import MeshingConfig
from more2_jax.meshing import extract as meshing
from more2_jax.meshing.extract import HALF_WIDTH, extract_mesh
from more2_jax.meshing.grid import cube
from more2_jax.meshing.observed_surface import (
    FACING_POWER,
    MAX_POINTS,
    MIN_POINTS,
    QUERY_PLANES,
    QUERY_PLANES_NOISELESS,
    ObservedSurface,
    fit_observed_surface,
    uniform_subsample,
)
from more2_jax.meshing.planes import fit_planes
from more2_jax.types import Embedding

REACH = 0.03
CONFIG = MeshingConfig(coarse_resolution=16, resolution=64, mls_bandwidth=REACH)
PIECE = Embedding(
    inv=np.zeros(4, np.float32),
    eqv=np.zeros((3, 4), np.float32),
    scale=np.float32(2.0),
    center=np.array([0.1, -0.2, 0.05], np.float32),
    origin=np.array([1000.0, -2000.0, 5.0]),
)


def sphere(count, radius, seed=0):
    p = np.random.default_rng(seed).normal(size=(count, 3))
    return radius * p / np.linalg.norm(p, axis=1, keepdims=True)


def in_scan(canonical):
    return 2.0 * canonical + PIECE.center.astype(np.float64) + PIECE.origin


def in_canonical(points):
    return (points - PIECE.center.astype(np.float64) - PIECE.origin) / 2.0


@pytest.fixture
def ball_of_036(monkeypatch):
    """The decoder believes in a ball of radius 0.36."""

    def offset(embedding, points):
        return (np.asarray(points, np.float64) - np.asarray(embedding.center)) / 2.0

    def values(prior, embedding, points):
        return jnp.asarray(np.linalg.norm(offset(embedding, points), axis=1) - 0.36, jnp.float32)

    def slopes(prior, embedding, points):
        q = offset(embedding, points)
        return jnp.asarray(q / np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-9), jnp.float32)

    monkeypatch.setattr(meshing, "_field_values", values)
    monkeypatch.setattr(meshing, "_field_gradients", slopes)


@pytest.mark.parametrize("noise", [0.0, 0.005])
def test_the_mesh_runs_through_what_was_seen_and_follows_the_field_elsewhere(ball_of_036, tiny_prior, noise):
    upper = sphere(4000, 0.4)
    upper = upper[upper[:, 2] > 0]
    seen = upper + noise * np.random.default_rng(1).normal(size=upper.shape)
    mesh = extract_mesh(tiny_prior, PIECE, CONFIG, seen=in_scan(seen))
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).is_watertight
    p = in_canonical(mesh.vertices)
    radius, height = np.linalg.norm(p, axis=1), p[:, 2]
    # Where nothing was seen the ball goes on; between the two there is a step, which is what the reach blurs.
    np.testing.assert_allclose(radius[height < -0.1], 0.36, atol=0.005)
    assert abs(np.median(radius[height > 0.1]) - 0.4) < 0.004 and radius[height > 0.1].max() < 0.4 + 5 * (
        noise + 0.002
    )
    found = trimesh.Trimesh(p, mesh.faces, process=False).sample(20_000, seed=0)
    assert cKDTree(found).query(upper)[0].max() < 0.03
    alone = extract_mesh(
        tiny_prior, PIECE, MeshingConfig(coarse_resolution=16, resolution=64), seen=in_scan(seen)
    )
    np.testing.assert_allclose(np.linalg.norm(in_canonical(alone.vertices), axis=1), 0.36, atol=0.005)


def test_too_few_points_leave_the_field_alone(ball_of_036, tiny_prior):
    seen = in_scan(sphere(MIN_POINTS - 1, 0.4))
    mesh = extract_mesh(tiny_prior, PIECE, CONFIG, seen=seen)
    np.testing.assert_allclose(np.linalg.norm(in_canonical(mesh.vertices), axis=1), 0.36, atol=0.005)


def test_on_a_plane_the_distance_is_the_offset_and_far_away_the_field():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (3000, 2)), np.full(3000, 0.1)])
    surface = fit_observed_surface(points, np.tile([0.0, 0.2, 3.0], (3000, 1)), REACH)
    height = np.array([-0.01, 0.0, 0.01, 0.3])
    queries = np.column_stack([np.zeros((4, 2)), 0.1 + height])
    found = surface.corrected(queries, np.full(4, 0.7))
    along = surface.tree.query(queries)[0] ** 2 - height**2
    say = np.exp(-((height / REACH) ** 4) - (along / surface.gap**2) ** 2)
    np.testing.assert_allclose(found, say * height + (1 - say) * 0.7, atol=1e-9)
    assert say[1] > 0.9 and found[3] == 0.7


def test_of_an_open_sheet_the_field_says_which_side_is_inside():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (2000, 2)), np.zeros(2000)])
    up = np.tile([0.0, 0.0, 1.0], (2000, 1))
    queries, far = rng.uniform(-0.3, 0.3, (200, 3)) * [1, 1, 0.03], np.zeros(200)
    out, inward = (fit_observed_surface(points, s * up, REACH).corrected(queries, far) for s in (1, -1))
    np.testing.assert_allclose(out, -inward, atol=1e-12)
    assert (np.sign(out) == np.sign(queries[:, 2])).all()


def test_of_a_closed_body_the_points_say_it_whatever_the_field_does():
    points, queries = sphere(2000, 0.3), sphere(200, 0.31, seed=5)
    for field in (1.0, -1.0):
        assert (
            fit_observed_surface(points, field * points, REACH).corrected(queries, np.zeros(200)) > 0
        ).all()


def test_turning_everything_changes_nothing():
    R = Rotation.random(random_state=0).as_matrix()
    points, queries = (
        sphere(1000, 0.3) * [1.0, 0.7, 0.4],
        np.random.default_rng(2).uniform(-0.4, 0.4, (500, 3)),
    )
    slope, field = points / [1.0, 0.49, 0.16], np.linspace(-1, 1, 500)
    here = fit_observed_surface(points, slope, REACH).corrected(queries, field)
    turned = fit_observed_surface(points @ R.T, slope @ R.T, REACH).corrected(queries @ R.T, field)
    np.testing.assert_allclose(turned, here, atol=1e-6)  # planes are single precision
    assert (here != field).any() and (here == field).any()


@pytest.mark.parametrize(
    "points",
    [np.zeros((40, 3)), np.repeat(np.eye(3), 20, axis=0), np.outer(np.linspace(0, 1, 50), [1.0, 2.0, 3.0])],
    ids=["one point", "three points", "a line"],
)
def test_points_without_a_plane_give_finite_values(points):
    surface = fit_observed_surface(points, np.ones_like(points), REACH)
    values = surface.corrected(np.random.default_rng(0).uniform(-1, 1, (100, 3)), np.ones(100))
    assert np.isfinite(values).all()


def test_at_most_so_many_points_are_kept_from_first_to_last():
    points = np.arange(3 * (MAX_POINTS + 5000.0)).reshape(-1, 3)
    kept = uniform_subsample(points)
    assert len(kept) == MAX_POINTS and (kept[[0, -1]] == points[[0, -1]]).all()
    np.testing.assert_array_equal(uniform_subsample(points[:10]), points[:10])


def test_what_was_seen_is_drawn_finer_than_the_field_is_asked(ball_of_036, tiny_prior):
    waves = sphere(4000, 1.0)
    radius = 0.37 + 0.01 * np.sin(
        8 * np.arctan2(waves[:, 1], waves[:, 0])
    )  # a wave is 0.3 long: 4 of 16 cells
    config = MeshingConfig(coarse_resolution=16, resolution=64, field_resolution=16, mls_bandwidth=REACH)
    mesh = extract_mesh(tiny_prior, PIECE, config, seen=in_scan(waves * radius[:, None]))
    p = in_canonical(mesh.vertices)
    p = p[np.abs(p[:, 2]) < 0.2]
    expected = 0.37 + 0.01 * np.sin(8 * np.arctan2(p[:, 1], p[:, 0]))
    off = np.abs(np.linalg.norm(p, axis=1) - expected)
    assert (
        np.quantile(off, 0.9) < 0.005
    )  # half a wave's height; the ball that the field believes in is 0.01 off


def test_every_corner_that_is_drawn_is_near():
    surface = fit_observed_surface(
        sphere(2000, 0.3) + [0.25, 0, 0], sphere(2000, 0.3), REACH
    )  # partly beyond the grid
    lattice = cube(36, 0.45)
    near, corners = lattice.corners_near(surface.points, surface.cutoff), lattice.corners()
    drawn = surface.corrected(corners, np.full(len(corners), 5.0)) != 5.0
    assert drawn.any() and near.ravel()[drawn].all() and near.mean() < 0.5


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_query_is_drawn_to_its_planes_by_definition(noise):
    """Weights of the planes of the nearest point's neighbors, one query at a time."""
    rng = np.random.default_rng(1)
    points = sphere(800, 0.3) + noise * rng.normal(size=(800, 3))
    s = fit_observed_surface(points, points, REACH)
    queries, field = rng.uniform(-0.4, 0.4, (2000, 3)), rng.normal(size=2000)
    expected = field.copy()
    for n, (distance, k) in enumerate(zip(*s.tree.query(queries), strict=True)):
        if distance > s.cutoff:
            continue
        near = s.neighbors[k, : QUERY_PLANES_NOISELESS if s.noiseless else QUERY_PLANES]
        facing = np.maximum(s.normal[near] @ s.normal[k], 0) ** FACING_POWER
        weight = facing * np.exp(-0.5 * ((queries[n] - s.points[near]) ** 2).sum(axis=1) / s.gap**2)
        plane = weight @ ((queries[n] - s.center[near]) * s.normal[near]).sum(axis=1) / weight.sum()
        along = max(distance**2 - plane**2, 0)
        share = np.exp(-((plane / s.bandwidth) ** 4) - (along / s.gap**2) ** 2)
        expected[n] += share * (plane - field[n])
    assert (expected != field).sum() > 300
    np.testing.assert_allclose(s.corrected(queries, field), expected, atol=1e-12)


@pytest.mark.parametrize("least", [0.002, 0.01, 0.05])
def test_farther_off_than_signs_reach_no_sign_changes(least):
    s = fit_observed_surface(sphere(800, 0.3), sphere(800, 0.3), REACH)
    queries = np.random.default_rng(0).uniform(-0.5, 0.5, (200_000, 3))
    away = s.tree.query(queries)[0]
    for field in (-least, least):
        changed = s.corrected(queries, np.full(len(queries), field)) * field <= 0
        assert changed.any() and away[changed].max() < s.sign_reach(least) < s.cutoff


@pytest.mark.parametrize("radius", [0.4, 0.75])  # the larger one is cut by the box
def test_what_only_needs_a_sign_changes_no_mesh(ball_of_036, tiny_prior, radius, monkeypatch):
    config = dataclasses.replace(CONFIG, resolution=64, field_resolution=16, screening_length=0.1)
    seen, asked, meshes = in_scan(sphere(6000, radius)), [], []
    corrected = ObservedSurface.corrected

    def counted(surface, queries, *rest):
        asked[-1] += len(queries)
        return corrected(surface, queries, *rest)

    monkeypatch.setattr(ObservedSurface, "corrected", counted)
    for sure in (meshing.SURE_CELLS, np.inf):
        monkeypatch.setattr(meshing, "SURE_CELLS", sure)
        asked.append(0)
        meshes.append(extract_mesh(tiny_prior, PIECE, config, seen=seen))
    np.testing.assert_array_equal(meshes[0].vertices, meshes[1].vertices)
    np.testing.assert_array_equal(meshes[0].faces, meshes[1].faces)
    assert radius > HALF_WIDTH or asked[0] < 0.9 * asked[1]


@pytest.mark.parametrize(("noise", "finer"), [(0.0, True), (0.02, False)])
def test_a_grid_is_as_fine_as_the_points_are_exact(ball_of_036, tiny_prior, noise, finer, monkeypatch):
    grids, sided = [], meshing._screened

    def noted(*asked):
        found = sided(*asked)
        grids.append(round(2 * HALF_WIDTH / found.lattice.step))
        return found

    monkeypatch.setattr(meshing, "_screened", noted)
    seen = sphere(6000, 0.4) * (1 + noise * np.random.default_rng(0).normal(size=(6000, 1)))
    config = dataclasses.replace(CONFIG, resolution=64, field_resolution=16, screening_length=0.1)
    mesh = extract_mesh(tiny_prior, PIECE, config, seen=in_scan(seen))
    assert grids == [64 if finer else 32]
    radius = np.linalg.norm(in_canonical(mesh.vertices), axis=1)
    assert abs(np.median(radius) - 0.4) < 0.004 + noise / 4


def leg(noise=0.0):
    """The four sides of an upright square leg, 0.06 wide, and which way each point's side faces."""
    rng = np.random.default_rng(0)
    side, along, height = (
        rng.integers(0, 4, 6000),
        rng.uniform(-0.03, 0.03, 6000),
        rng.uniform(-0.4, 0.4, 6000),
    )
    outward = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])[side]
    points = 0.03 * outward + along[:, None] * np.cross(outward, [0, 0, 1.0])
    points[:, 2] = height
    return points + noise * rng.normal(size=points.shape), outward


def test_exact_points_beside_an_edge_face_as_their_side_does():
    points, outward = leg()
    found = fit_observed_surface(points, points * [1, 1, 0], REACH)
    assert found.noiseless and (found.center == points).all()
    faces = np.einsum("ni,ni->n", found.normal, outward)
    plain = fit_planes(points, found.neighbors).normal
    assert np.mean(faces > 0.99) > 0.97 > 0.9 > np.mean(np.abs(np.einsum("ni,ni->n", plain, outward)) > 0.99)


def test_along_scan_lines_neighbors_of_one_line_make_no_plane():
    """Points four times as dense along lines as across: the six nearest are of one line, not the twelve nearest."""
    along, across = np.meshgrid(np.arange(-0.3, 0.3, 0.001), np.arange(-0.05, 0.05, 0.004))
    points = np.column_stack([along.ravel(), across.ravel(), np.zeros(along.size)])
    points = np.concatenate([points, points[:, [0, 2, 1]] + [0, 0.1, 0.1]])  # floor and wall
    outward = np.repeat([[0.0, 0, 1], [0, -1, 0]], along.size, axis=0)
    R = Rotation.random(random_state=0).as_matrix()  # no axis of the frame is a normal by chance
    points, outward = points @ R.T, outward @ R.T
    found = fit_observed_surface(points, outward, REACH)
    assert found.noiseless
    faces = np.einsum("ni,ni->n", found.normal, outward)
    nearest = np.abs(np.einsum("ni,ni->n", fit_planes(points, found.neighbors[:, :6]).normal, outward))
    assert np.mean(faces > 0.99) > 0.9 > 0.7 > np.mean(nearest > 0.99)


def test_of_noisy_points_planes_stay_means():
    points, _ = leg(noise=0.003)
    found = fit_observed_surface(points, points * [1, 1, 0], REACH)
    plain = fit_planes(points, found.neighbors)
    assert not found.noiseless and (found.center == plain.center).all()
    np.testing.assert_allclose(np.abs(np.einsum("ni,ni->n", found.normal, plain.normal)), 1.0, rtol=1e-6)


def bowl():
    """The inner half of a hollow ball of radius 0.4, seen alone: what lies behind it says nothing."""
    p = sphere(3000, 0.4)
    return p[p[:, 2] < 0]


@pytest.mark.parametrize(("eye", "outward"), [([0.0, 0.0, 3.0], -1.0), ([0.0, 0.0, -3.0], 1.0)])
def test_a_sheet_faces_who_saw_it_whatever_the_field_says(eye, outward):
    points = bowl()
    places = np.full((len(points), 2, 3), np.nan)
    places[:, 0] = eye
    for field in (1.0, -1.0):
        found = fit_observed_surface(points, field * points, REACH, sensors=places)
        facing = outward * np.einsum("ni,ni->n", found.normal, points) > 0
        assert facing.mean() > 0.99


def test_a_mesh_is_told_who_saw_its_points(ball_of_036, tiny_prior):
    """A shell that the field takes for a ball: seen from within, its inside is free."""
    within = sphere(4000, 0.3)
    config = dataclasses.replace(CONFIG, field_resolution=32, screening_length=0.15)
    places = np.broadcast_to(in_scan(np.zeros(3)), (len(within), 1, 3))
    shell = extract_mesh(tiny_prior, PIECE, config, seen=in_scan(within), seen_from=places)
    whole = extract_mesh(tiny_prior, PIECE, config, seen=in_scan(within))
    asked = in_scan(np.array([[0.0, 0, 0], [0.33, 0, 0]]))
    for mesh, solid in ((shell, [False, True]), (whole, [True, False])):
        assert list(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).contains(asked)) == solid


@pytest.mark.parametrize(("noise", "solid"), [(0.0, False), (0.01, True)])
def test_sides_of_exact_points_of_several_scans_reach_farther(ball_of_036, tiny_prior, noise, solid):
    within = sphere(4000, 0.3) * (1 + noise * np.random.default_rng(0).normal(size=(4000, 1)))
    config = dataclasses.replace(
        CONFIG, field_resolution=32, screening_length=0.03, screening_length_multi_scan=0.15
    )
    places = np.broadcast_to(in_scan(np.zeros(3)), (len(within), 1, 3))
    mesh = extract_mesh(tiny_prior, PIECE, config, seen=in_scan(within), seen_from=places)
    middle = in_scan(np.zeros((1, 3)))
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).contains(middle) == solid
