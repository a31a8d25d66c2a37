"""What nobody saw must be sure to be inside; what the observed faces surround is."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from more2_jax.config import MeshingConfig, preset
from more2_jax.meshing import extract
from more2_jax.meshing.device.correction import OrientedPlanes
from more2_jax.meshing.device.unseen import raised as raised_on_device
from more2_jax.meshing.extract import extract_mesh
from more2_jax.meshing.grid import cube
from more2_jax.meshing.object_mesh import unseen_rise
from more2_jax.meshing.observed_surface import fit_observed_surface
from more2_jax.meshing.unseen import (
    BETWEEN,
    RISE_REACH,
    WINDING_POINTS,
    raised,
    share_of_rise,
    winding_number,
)
from more2_jax.types import AccumulatedObject, Embedding

# Compiled: one by one, its operations would take longer.
raised_by_device = jax.jit(raised_on_device)
REACH = 0.03
CONFIG = MeshingConfig(coarse_resolution=16, resolution=64, mls_bandwidth=REACH)
RISE = 0.5


def sphere(count, radius=0.36, seed=0):
    p = np.random.default_rng(seed).normal(size=(count, 3))
    return radius * p / np.linalg.norm(p, axis=1, keepdims=True)


def disc(count, radius):
    rng = np.random.default_rng(1)
    r, angle = radius * np.sqrt(rng.uniform(size=count)), rng.uniform(0, 2 * np.pi, count)
    points = np.stack([r * np.cos(angle), r * np.sin(angle), np.zeros(count)], axis=1)
    return points, np.tile([0.0, 0.0, 1.0], (count, 1)), np.full(count, np.pi * radius**2 / count)


@pytest.mark.parametrize("below", [0.05, 0.2, 1.0, -0.2])
def test_a_disc_surrounds_its_axis_by_its_solid_angle(below):
    found = winding_number(np.array([[0.0, 0.0, -below]]), *disc(20_000, 0.5))
    expected = np.sign(below) * 0.5 * (1 - abs(below) / np.hypot(below, 0.5))
    np.testing.assert_allclose(found, expected, atol=0.01)


def test_a_closed_surface_surrounds_what_is_within_once_and_nothing_else():
    points = sphere(30_000)
    area = np.full(30_000, 4 * np.pi * 0.36**2 / 30_000)
    inside = np.array([[0.0, 0, 0], [0.2, -0.1, 0.1]])
    outside = np.array([[0.6, 0.0, 0.0], [0.0, -2.0, 1.0]])
    np.testing.assert_allclose(winding_number(inside, points, points / 0.36, area), 1.0, atol=0.03)
    np.testing.assert_allclose(winding_number(outside, points, points / 0.36, area), 0.0, atol=0.03)


def test_winding_does_not_depend_on_frame_or_scale_and_is_bounded_at_a_point():
    points, normals, area = disc(500, 0.4)
    queries = np.random.default_rng(2).normal(size=(700, 3)) * 0.3
    turn = Rotation.random(random_state=3).as_matrix()
    moved = winding_number(2 * queries @ turn.T + 1, 2 * points @ turn.T + 1, normals @ turn.T, 4 * area)
    np.testing.assert_allclose(moved, winding_number(queries, points, normals, area), atol=1e-9)
    assert np.isfinite(winding_number(points, points, normals, area)).all()


def test_the_field_rises_with_the_distance_from_what_was_seen():
    points = sphere(2000)
    surface = fit_observed_surface(points, points, REACH)
    between = BETWEEN * np.sqrt(np.median(surface.areas))
    beyond = np.array([-between, 0.0, 0.02, RISE_REACH, 3 * RISE_REACH])
    queries = points[0] * (1 + (between + beyond[:, None]) / 0.36)
    field = np.array([0.1, 0.2, 0.3, 0.4, 0.5])
    risen = raised(surface, queries, field, RISE) - field
    np.testing.assert_allclose(risen, RISE * np.clip(beyond, 0, RISE_REACH), atol=1e-12)
    np.testing.assert_array_equal(raised(surface, queries, field, 0.0), field)


@pytest.mark.parametrize("count", [100, 400, 6000])
def test_what_lies_between_points_was_seen_however_few_they_are(count):
    """A sheet sampled at random: where the field rises at all, there is a hole."""
    points, normals, _ = disc(count, 0.5)
    surface = fit_observed_surface(points, normals, REACH)
    spacing = 0.5 * np.sqrt(np.pi / count)
    assert BETWEEN * np.sqrt(np.median(surface.areas)) == pytest.approx(BETWEEN * spacing, rel=0.35)
    places = disc(2000, 0.45)[0][::-1]
    risen = raised(surface, places, np.full(2000, 0.1), RISE) - 0.1
    assert (risen > 1e-9).mean() < 0.3  # exp(-π/2) of a plane with points at random
    assert risen.max() < 2 * RISE * spacing


def test_what_is_surrounded_stays_inside_however_unsure_the_field_is():
    points = sphere(4000)
    surface = fit_observed_surface(points, points, REACH)
    assert len(surface.points) > WINDING_POINTS
    unsure = np.full(1, -0.005)
    assert raised(surface, np.zeros((1, 3)), unsure, RISE) < 0
    half = points[points[:, 2] > 0]
    open_below = fit_observed_surface(half, half, REACH)
    assert raised(open_below, np.array([[0.0, 0, -0.1]]), unsure, RISE) > 0
    np.testing.assert_array_equal(share_of_rise(np.array([-0.5, 0.5, 0.75, 1.0, 1.2])), [1, 1, 0.5, 0, 0])


PIECE = Embedding(
    inv=np.zeros(4, np.float32),
    eqv=np.zeros((3, 4), np.float32),
    scale=np.float32(1.0),
    center=np.zeros(3, np.float32),
    origin=np.zeros(3),
)


def test_the_field_rises_for_what_is_open_where_up_is_known():
    robust, points = preset("robust", upright=True), sphere(100)
    on_legs, solid = (
        AccumulatedObject(
            points=points,
            observation=np.zeros(100, int),
            poses=np.eye(4)[None],
            embedding=PIECE,
            sensors=(points[:0],),
            seen_beneath=share,
        )
        for share in (1.0, 0.4)
    )
    assert unseen_rise(on_legs, robust) == robust.meshing.unseen_rise > 0
    assert unseen_rise(solid, robust) == 0.0
    assert unseen_rise(on_legs, dataclasses.replace(robust, upright=False)) == 0.0
    assert unseen_rise(on_legs, preset("paper", upright=True)) == 0.0


@pytest.fixture
def ball_of_036(monkeypatch):
    """The decoder believes in a ball of radius 0.36."""

    def values(prior, embedding, points):
        return jnp.asarray(np.linalg.norm(points, axis=1) - 0.36, jnp.float32)

    def slopes(prior, embedding, points):
        return jnp.asarray(
            points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-9), jnp.float32
        )

    monkeypatch.setattr(extract, "_field_values", values)
    monkeypatch.setattr(extract, "_field_gradients", slopes)


@pytest.mark.parametrize("screening_length", [0.0, 0.03])
def test_an_unseen_half_draws_back_and_a_seen_one_stays(ball_of_036, tiny_prior, screening_length):
    seen = sphere(4000)
    upper = seen[seen[:, 2] > 0]
    config = dataclasses.replace(CONFIG, field_resolution=32, screening_length=screening_length)
    plain, careful = (
        extract_mesh(tiny_prior, PIECE, dataclasses.replace(config, unseen_rise=rise), seen=upper)
        for rise in (0.0, RISE)
    )
    for mesh, below in ((plain, 0.36), (careful, 0.36 - RISE * RISE_REACH)):
        assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).is_watertight
        radius, height = np.linalg.norm(mesh.vertices, axis=1), mesh.vertices[:, 2]
        assert abs(np.median(radius[height > 2 * REACH]) - 0.36) < 0.003
        assert abs(np.median(radius[height < -2 * RISE_REACH]) - below) < 0.006


def planes_of(surface, fillers):
    def padded(x):
        return np.concatenate([x, np.zeros((fillers, *x.shape[1:]), x.dtype)])

    arrays = [padded(np.asarray(x)) for x in (surface.points, surface.center, surface.normal)]
    return OrientedPlanes(
        points=jnp.asarray(arrays[0], jnp.float32),
        mask=jnp.asarray(np.arange(len(arrays[0])) < len(surface.points)),
        center=jnp.asarray(arrays[1], jnp.float32),
        normal=jnp.asarray(arrays[2], jnp.float32),
        distance=jnp.asarray(padded(surface.distance), jnp.float32),
        neighbors=jnp.asarray(padded(surface.neighbors)),
        gap=jnp.float32(surface.gap),
        residual=jnp.float32(surface.residual),
        noiseless=jnp.asarray(surface.noiseless),
    )


@pytest.mark.parametrize(("count", "fillers"), [(3000, 1096), (15, 1009), (900, 0)])
def test_the_device_raises_as_the_host_does(count, fillers):
    points = sphere(count)
    points = points[points[:, 0] > -0.2] if count > 15 else points
    surface = fit_observed_surface(points, points, REACH)
    lattice = cube(16, 0.65)
    queries = lattice.corners()
    field = (0.3 * np.linalg.norm(queries, axis=1) - 0.1).astype(np.float32)
    expected = raised(surface, queries, field, RISE)
    grid = field.reshape(lattice.shape)
    found = raised_by_device(planes_of(surface, fillers), grid, np.float32(0.65), np.float32(RISE))
    np.testing.assert_allclose(np.asarray(found).ravel(), expected, atol=1e-4)
    assert np.abs(expected - field).max() == pytest.approx(RISE * RISE_REACH)


@jax.jit
@jax.grad
def slope_of_total(points, planes, *given):
    return raised_on_device(dataclasses.replace(planes, points=points), *given).sum()


def test_slopes_are_finite_where_a_corner_is_a_point():
    points = np.concatenate([sphere(300), cube(16, 0.65).corners()[2000:2001]])
    surface = fit_observed_surface(points, points, REACH)
    planes, grid = planes_of(surface, 3), np.full((17, 17, 17), -0.01, np.float32)
    slope = np.asarray(slope_of_total(planes.points, planes, grid, np.float32(0.65), np.float32(RISE)))
    assert np.isfinite(slope).all() and np.abs(slope).max() > 0
