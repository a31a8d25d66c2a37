"""Marching cubes on the device: closed whatever the values are, where scikit-image has it, of the right volume."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from shapes import box_distance
from skimage.measure import marching_cubes

from more2_jax.meshing.device.cube_table import CORNERS, EDGES, TRIANGLES
from more2_jax.meshing.device.isosurface import iso_surface

N = 33
AXIS = np.linspace(-1, 1, N)
GRID = np.stack(np.meshgrid(AXIS, AXIS, AXIS, indexing="ij"), axis=-1).reshape(-1, 3)
STEP = 2 / (N - 1)

FIELDS = {
    "ball": (lambda p: np.linalg.norm(p, axis=1) - 0.7, 4 / 3 * np.pi * 0.7**3),
    "box": (lambda p: box_distance(p, np.array([0.81, 0.5, 0.3])), 8 * 0.81 * 0.5 * 0.3),
    "torus": (
        lambda p: np.hypot(np.hypot(p[:, 0], p[:, 1]) - 0.6, p[:, 2]) - 0.2,
        2 * np.pi**2 * 0.6 * 0.2**2,
    ),
}
surface_of = jax.jit(iso_surface, static_argnums=2)
ROWS = 20_000  # room for vertices and cells


def solid(values, rows=ROWS):
    found = surface_of(np.asarray(values, np.float32), np.float32(1.0), rows)
    assert max(found.vertex_count, found.cell_count) <= rows
    faces = np.asarray(found.triangles).reshape(-1, 3)
    faces = faces[faces[:, 0] >= 0]
    return trimesh.Trimesh(np.asarray(found.vertices)[: int(found.vertex_count)], faces, process=False)


@pytest.mark.parametrize("name", FIELDS)
def test_known_bodies(name):
    field, volume = FIELDS[name]
    values = field(GRID).reshape(N, N, N)
    mesh = solid(values)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume * STEP**3 == pytest.approx(volume, rel=0.03)
    assert np.abs(field(mesh.vertices * STEP - 1)).max() < 0.3 * STEP


def test_vertices_are_those_of_scikit_image():
    values = FIELDS["torus"][0](GRID).reshape(N, N, N)
    theirs, faces, _, _ = marching_cubes(values.astype(np.float32), 0.0, gradient_direction="descent")
    ours = solid(values)
    assert len(ours.vertices) == len(theirs) and len(ours.faces) == len(faces)
    order = [np.lexsort(np.round(x, 3).T) for x in (ours.vertices, theirs)]
    np.testing.assert_allclose(ours.vertices[order[0]], theirs[order[1]], atol=1e-4)
    assert ours.volume == pytest.approx(trimesh.Trimesh(theirs, faces).volume, rel=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_noise_is_closed(seed):
    """All cases of a cell's corners, and of the two cells beside a face, come up in noise."""
    values = np.random.default_rng(seed).normal(size=(20, 20, 20))
    mesh = solid(values)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    inside = np.pad(values < 0, 1)
    i, j, k = (n - 1 for n in inside.shape)
    cases = sum(inside[x : x + i, y : y + j, z : z + k] << b for b, (x, y, z) in enumerate(CORNERS))
    assert len(np.unique(cases)) == 256


def test_every_case_uses_the_edges_that_are_crossed():
    for case, triangles in enumerate(TRIANGLES):
        inside = {c: case >> i & 1 for i, c in enumerate(CORNERS)}
        ends = [(c, tuple(np.add(c, np.eye(3, dtype=int)[axis]))) for axis, c in EDGES]
        crossed = {e for e, (a, b) in enumerate(ends) if inside[a] != inside[b]}
        assert set(triangles[triangles >= 0].tolist()) == crossed


def test_a_body_that_leaves_the_grid_is_closed_at_its_border():
    mesh = solid(np.full((6, 6, 6), -1.0))
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(6**3, rel=0.1)


def test_no_surface_has_no_rows():
    found = surface_of(np.ones((6, 6, 6), np.float32), np.float32(1.0), 100)
    assert int(found.vertex_count) == int(found.cell_count) == 0
    assert (np.asarray(found.triangles) == -1).all()


def test_more_than_there_is_room_for_is_told():
    values = FIELDS["ball"][0](GRID).reshape(N, N, N).astype(np.float32)
    whole, little = (surface_of(values, np.float32(1.0), rows) for rows in (ROWS, 100))
    assert int(little.vertex_count) == int(whole.vertex_count) > 100
    assert int(little.cell_count) == int(whole.cell_count) > 100


@jax.jit
@jax.grad
def slope_of_radius(level, values):
    found = iso_surface(values - level, jnp.float32(1.0), ROWS)
    real = jnp.arange(ROWS) < found.vertex_count
    return jnp.where(real, jnp.linalg.norm(found.vertices - (N - 1) / 2, axis=1), 0.0).sum() / real.sum()


def test_vertices_follow_the_values():
    values = FIELDS["ball"][0](GRID).reshape(N, N, N).astype(np.float32)
    assert float(slope_of_radius(0.0, values)) == pytest.approx((N - 1) / 2, rel=0.05)
