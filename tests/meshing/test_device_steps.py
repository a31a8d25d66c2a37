"""Each step of meshes on the device against the host's NumPy and SciPy, on easy clouds and hard ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from more2_jax.geometry import outliers
from more2_jax.meshing import grid, normal_orientation, planes, screened_poisson
from more2_jax.meshing.device import lattice
from more2_jax.meshing.device import planes as device_planes
from more2_jax.meshing.device import screened as device_screened
from more2_jax.meshing.device.correction import OrientedPlanes, corrected
from more2_jax.meshing.device.neighbors import inliers, nearest_neighbors, with_slopes
from more2_jax.meshing.device.rows import evenly, masked_median, true_places
from more2_jax.meshing.device.sides import Cloud, Views, free_distance, outward_signs
from more2_jax.meshing.observed_surface import ObservedSurface, fit_observed_surface

SIZE, CELLS, HALF = 700, 32, np.float32(0.65)
STEP = 2 * float(HALF) / CELLS
# Compiled: one by one, their operations would take longer.
nearest_of, slopes_with = jax.jit(nearest_neighbors, static_argnums=2), jax.jit(with_slopes)
inliers_of, planes_of = jax.jit(inliers), jax.jit(device_planes.fit_planes)
free_along, signs_of = jax.jit(free_distance, static_argnums=3), jax.jit(outward_signs)
nearest_of_corners = jax.jit(lattice.nearest_on_lattice, static_argnums=2)
drawn_to, areas_of = jax.jit(corrected, static_argnums=(2, 4)), jax.jit(device_planes.surface_areas)
screened_by = jax.jit(device_screened.screened_poisson, static_argnums=8)
upsampled = jax.jit(lattice.upsampled)
median_of, evenly_of, places_of = (
    jax.jit(masked_median),
    jax.jit(evenly, static_argnums=1),
    jax.jit(true_places, static_argnums=1),
)


def box_cloud(count, rng, noise=0.0):
    """Points of the faces of a box, and which way these face."""
    half, face = np.array([0.4, 0.25, 0.15]), rng.integers(0, 6, count)
    points = rng.uniform(-1, 1, (count, 3)) * half
    outward = np.zeros((count, 3))
    outward[np.arange(count), face // 2] = np.where(face % 2, 1.0, -1.0)
    points[np.arange(count), face // 2] = half[face // 2] * np.where(face % 2, 1.0, -1.0)
    return points + noise * rng.normal(size=points.shape), outward


def clouds():
    rng = np.random.default_rng(5)
    flat = rng.uniform(-0.4, 0.4, (500, 3)) * [1, 1, 0]
    far = np.concatenate([box_cloud(600, rng)[0], rng.uniform(-0.6, 0.6, (20, 3))])
    return {
        "box": box_cloud(600, rng)[0],
        "noisy": box_cloud(600, rng, 0.01)[0],
        "few": box_cloud(15, rng)[0],
        "doubled": np.repeat(box_cloud(250, rng)[0], 2, axis=0),
        "plane": flat,
        "outliers": far,
    }


CLOUDS = {name: cloud.astype(np.float32).astype(np.float64) for name, cloud in clouds().items()}


def padded(rows, fill=0.0):
    return np.concatenate([rows, np.full((SIZE - len(rows), *rows.shape[1:]), fill)]).astype(np.float32)


def real(points):
    return np.arange(SIZE) < len(points)


def searched(points):
    """The host's neighbors, for both: where distances are equal, either may name other points."""
    distance, neighbors = KDTree(points).query(points, k=12)
    return distance, neighbors, padded(distance), padded(neighbors).astype(np.int32)


@pytest.mark.parametrize("name", CLOUDS)
def test_neighbors_are_as_far_as_by_tree(name):
    points = CLOUDS[name]
    distance, index = nearest_of(padded(points), real(points), 12)
    distance = np.asarray(distance)
    np.testing.assert_allclose(distance[: len(points)], KDTree(points).query(points, k=12)[0], atol=1e-6)
    assert (np.asarray(index)[: len(points)] < len(points)).all()
    apart = np.linalg.norm(points[:, None] - points[np.asarray(index)[: len(points)]], axis=2)
    np.testing.assert_allclose(distance[: len(points)], apart, atol=1e-6)


@jax.jit
@jax.grad
def slopes_of_distances(x, weights, fixed, index, known):
    return (weights * with_slopes(fixed, x, index, known)).sum()


@pytest.mark.parametrize("name", CLOUDS)
def test_distances_of_neighbors_are_the_same_with_slopes_by_both_points(name):
    x, known = padded(CLOUDS[name]), real(CLOUDS[name])
    fixed, index = nearest_of(x, known, 12)
    np.testing.assert_array_equal(slopes_with(fixed, x, index, known), fixed)
    weights = np.random.default_rng(0).normal(size=fixed.shape)
    slope = slopes_of_distances(x, weights, fixed, index, known)
    apart = np.asarray(x, np.float64)[:, None] - np.asarray(x, np.float64)[np.asarray(index)]
    length = np.linalg.norm(apart, axis=2, keepdims=True)
    told = (length > 0) & np.asarray(known)[:, None, None] & np.asarray(known)[np.asarray(index)][..., None]
    way = np.where(told, weights[..., None] * apart / np.where(length > 0, length, 1), 0)
    expected = way.sum(axis=1)
    np.subtract.at(expected, np.asarray(index), way)
    np.testing.assert_allclose(slope, expected, atol=2e-4)


@pytest.mark.parametrize("factor", [0.0, 1.25, 1.5])
@pytest.mark.parametrize("name", CLOUDS)
def test_outliers_are_the_same(name, factor):
    points = CLOUDS[name]
    kept = np.asarray(inliers_of(padded(points), real(points), np.float32(factor)))
    expected = outliers.inliers(points, factor)
    assert not kept[len(points) :].any()
    close = np.abs(outliers.outlier_factors(points) - factor) < 1e-4
    np.testing.assert_array_equal(kept[: len(points)][~close], expected[~close])
    assert name != "outliers" or not factor or not expected.all()


# Not of doubled points: the plane nearby that fits best is any of those through three places.
@pytest.mark.parametrize("name", ["box", "noisy", "few", "plane"])
def test_planes_are_the_same_but_for_their_sign(name):
    points = CLOUDS[name]
    _, near, _, neighbors = searched(points)
    host = planes.fit_planes(points, near)
    found = planes_of(padded(points), real(points), neighbors)
    residual = np.sqrt(max(np.median(host.residual_variance), 0))
    noiseless = residual < 0.1 * np.sqrt(np.median(host.total_variance))
    assert bool(found.noiseless) == noiseless == (name in ("box", "plane"))
    expected = planes.face_normals(points, near, host.normal) if noiseless else host.normal
    told = planes.aspect(planes.neighborhood_moments(points, near)[1], host.residual_variance) > 0.2
    agree = np.abs((np.asarray(found.normal)[: len(points)] * expected).sum(axis=1))[told]
    assert told.mean() > 0.5 and (agree > 0.999).mean() > 0.97  # beside an edge two planes may fit as well
    assert float(found.residual) == pytest.approx(residual, abs=1e-4)


@jax.jit
def slope_of_normals(points):
    def total(x):
        every = jnp.ones(len(x), bool)
        _, neighbors = nearest_neighbors(x, every, 8)
        return (device_planes.fit_planes(x, every, neighbors).normal * jnp.arange(1.0, 4.0)).sum()

    return jax.grad(total)(points)


@pytest.mark.parametrize("spread", [1e-1, 1e-4, 1e-8, 1e-10, 1e-13, 1e-16, 1e-20, 0.0])
@pytest.mark.parametrize("place", [0.0, 1e-8, 0.1])
def test_normals_of_neighbors_however_close_have_finite_slopes(place, spread):
    noise = np.random.default_rng(0).normal(size=(40, 3))
    slope = np.asarray(slope_of_normals((place + spread * noise).astype(np.float32)))
    assert np.isfinite(slope).all() and (np.abs(slope).max() > 0) == (spread > 1e-6)


@pytest.mark.parametrize(("lowest", "slope"), [(-np.inf, 0.45), (-0.2, 0.45), (-np.inf, 0.25)])
def test_rays_go_as_far_as_by_tree(lowest, slope):
    """Also past the origin, where padding lies."""
    points, outward = box_cloud(600, np.random.default_rng(2))
    points = points.astype(np.float32).astype(np.float64)
    _, _, d, neighbors = searched(points)
    cloud = Cloud(
        points=jnp.asarray(padded(points)),
        mask=jnp.asarray(real(points)),
        distance=jnp.asarray(d),
        neighbors=jnp.asarray(neighbors),
        gap=jnp.float32(0.1),
        lowest=jnp.float32(lowest),
    )
    for way in (outward, -outward, np.roll(outward, 1, axis=1)):
        expected = normal_orientation.free_distance(KDTree(points), points, way, 0.1, lowest, slope)
        found = free_along(cloud, points.astype(np.float32), way.astype(np.float32), slope)
        assert np.isclose(found, expected, rtol=1e-5).mean() > 0.995  # but for points on a cone's border
    assert (expected < 1).mean() > 0.2


@pytest.mark.parametrize("known", ["nothing", "sensors", "normals"])
def test_sides_are_the_same(known):
    rng = np.random.default_rng(2)
    points, outward = box_cloud(600, rng)
    normal = outward * rng.choice([-1.0, 1.0], (600, 1))
    slope = np.clip(rng.normal(size=600), -1, 1)
    eyes = np.full((600, 8, 3), np.nan)
    eyes[:, :2] = rng.normal(size=(600, 2, 3)) * 2
    distance, near, d, neighbors = searched(points)
    sides = np.where(rng.random((600, 1)) < 0.5, outward, 0.0)
    expected = normal_orientation.outward_signs(
        KDTree(points),
        normal,
        slope,
        0.1,
        -0.2,
        eyes if known == "sensors" else None,
        (distance, near),
        sides if known == "normals" else None,
    )
    cloud = Cloud(
        points=jnp.asarray(padded(points)),
        mask=jnp.asarray(real(points)),
        distance=jnp.asarray(d),
        neighbors=jnp.asarray(neighbors),
        gap=jnp.float32(0.1),
        lowest=jnp.float32(-0.2),
    )
    views = Views(
        sensors=padded(eyes if known == "sensors" else np.full_like(eyes, np.nan), np.nan),
        normals=padded(sides if known == "normals" else np.zeros_like(sides)),
        known=jnp.asarray(known != "nothing"),
    )
    found = signs_of(cloud, padded(normal), padded(slope), views)
    assert (np.asarray(found)[:600] == expected).mean() > 0.995
    assert 0.2 < (expected > 0).mean() < 0.8


@pytest.mark.parametrize("name", CLOUDS)
def test_corners_know_their_nearest_points(name):
    points = CLOUDS[name]
    found = nearest_of_corners(padded(points), real(points), CELLS, HALF)
    corners = grid.cube(CELLS, float(HALF)).corners()
    index = np.asarray(found).ravel()
    assert index.max() < len(points)
    exact = KDTree(points).query(corners)[0]
    over = np.linalg.norm(points[index] - corners, axis=1) - exact
    near = exact < 4 * STEP
    assert (over[near] < 1e-5).mean() > 0.98 and over[near].max() < STEP


def oriented(points, normal):
    """One surface as the host and as the device have it."""
    gradient = normal.copy()
    surface = fit_observed_surface(points, gradient, 0.03)
    assert isinstance(surface, ObservedSurface)
    same = OrientedPlanes(
        points=jnp.asarray(padded(points)),
        mask=jnp.asarray(real(points)),
        center=jnp.asarray(padded(surface.center)),
        normal=jnp.asarray(padded(surface.normal)),
        distance=jnp.asarray(padded(surface.distance)),
        neighbors=jnp.asarray(padded(surface.neighbors).astype(np.int32)),
        gap=jnp.float32(surface.gap),
        residual=jnp.float32(surface.residual),
        noiseless=jnp.asarray(surface.noiseless),
    )
    return surface, same


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_values_are_drawn_to_the_same_planes(noise):
    points, outward = box_cloud(600, np.random.default_rng(1), noise)
    surface, same = oriented(points, outward)
    assert surface.noiseless == (noise == 0)
    corners = grid.cube(CELLS, float(HALF)).corners()
    field = np.linalg.norm(corners, axis=1) - 0.3
    expected = surface.corrected(corners, field)
    drawn = drawn_to(field.reshape((CELLS + 1,) * 3).astype(np.float32), same, CELLS, HALF, 0.03)
    off = np.abs(np.asarray(drawn).ravel() - expected)
    assert (np.abs(expected - field) > 1e-3).sum() > 1000
    assert (off < 1e-4).mean() > 0.995


def test_the_screened_equation_is_the_same():
    points, outward = box_cloud(600, np.random.default_rng(1))
    surface, same = oriented(points, outward)
    space = grid.cube(CELLS, float(HALF))
    field = np.linalg.norm(space.corners(), axis=1).reshape(space.shape) - 0.3
    areas = screened_poisson.surface_areas(points, surface.normal, surface.distance, surface.neighbors)
    area = areas_of(same.points, same.normal, same.distance, same.neighbors)
    np.testing.assert_allclose(np.asarray(area)[:600], areas, rtol=1e-3)
    expected = screened_poisson.screened_poisson(field, space, points, surface.normal, areas, 0.1)
    found = screened_by(
        field.astype(np.float32),
        same.points,
        same.mask,
        same.normal,
        area,
        HALF,
        np.float32(STEP),
        np.float32(0.1),
        0.1,
    )
    assert np.abs(expected - field)[np.abs(field) < STEP].max() > 0.5 * STEP
    np.testing.assert_allclose(found, expected, atol=0.01 * STEP)


def test_interpolation_is_the_same():
    x = np.random.default_rng(0).normal(size=(5, 6, 7))
    np.testing.assert_allclose(upsampled(x), grid.upsampled(x), atol=1e-6)


@pytest.mark.parametrize("count", [0, 1, 2, 7, 10])
def test_statistics_of_real_rows_alone(count):
    x, mask = np.random.default_rng(0).normal(size=10).astype(np.float32), np.arange(10) < count
    expected = np.median(x[mask]) if count else 0.0
    assert float(median_of(x, mask)) == pytest.approx(expected)
    row, taken = evenly_of(np.asarray(count), 4)
    np.testing.assert_array_equal(
        np.asarray(row)[np.asarray(taken)], np.linspace(0, count - 1, min(count, 4)).astype(int)
    )
    places, counts = places_of(mask[::-1], 4)
    np.testing.assert_array_equal(np.asarray(places)[: min(count, 4)], np.flatnonzero(mask[::-1])[:4])
    assert counts[-1] == count
