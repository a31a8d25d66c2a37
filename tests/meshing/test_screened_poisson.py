"""Inside by oriented points, screened by a field: known bodies; far from points the field's; no matter the order."""

import numpy as np
import pytest
from scipy.spatial import KDTree
from shapes import box_distance

from more2_jax.meshing.grid import GridField, cube
from more2_jax.meshing.screened_poisson import (
    TRANSITION_CELLS,
    along_first,
    fourier,
    inverse,
    screened_poisson,
    splat,
    surface_areas,
)

N, HALF, LENGTH = 49, 0.6, 0.1
LATTICE = cube(N - 1, HALF)
STEP = 2 * HALF / (N - 1)
AXIS = np.linspace(-HALF, HALF, N)
GRID = np.stack(np.meshgrid(AXIS, AXIS, AXIS, indexing="ij"), axis=-1)


def sphere(count=4000, radius=0.35, seed=0):
    n = np.random.default_rng(seed).normal(size=(count, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    return radius * n, n, np.full(count, 4 * np.pi * radius**2 / count)


def board(height, face, count=2500):
    """One face of a board of 0.8 × 0.8 at a height, its normal up or down."""
    p = np.random.default_rng(int(1000 * abs(height))).uniform(-0.4, 0.4, (count, 3))
    p[:, 2] = height
    return p, np.tile([0.0, 0.0, face], (count, 1)), np.full(count, 0.64 / count)


def test_right_points_leave_a_right_field_as_it_is():
    field = np.linalg.norm(GRID, axis=-1) - 0.35
    found = screened_poisson(field, LATTICE, *sphere(), LENGTH)
    assert ((found < 0) == (field < 0))[np.abs(field) > 1.5 * STEP].mean() > 0.999
    near = np.abs(field) < 0.5 * STEP
    np.testing.assert_allclose(found[near], field[near], atol=0.6 * STEP)


def test_points_hollow_out_what_the_field_takes_for_solid():
    """A shelf of two boards with 0.1 between them: for the field one block."""
    block = box_distance(GRID.reshape(-1, 3), np.array([0.4, 0.4, 0.1])).reshape(N, N, N)
    faces = [board(0.1, 1), board(0.05, -1), board(-0.05, 1), board(-0.1, -1)]
    points, normals, area = (np.concatenate(x) for x in zip(*faces, strict=True))
    found = screened_poisson(block, LATTICE, points, normals, area, 0.15)
    inner = np.abs(GRID[..., :2]).max(axis=-1) < 0.3
    height = np.abs(GRID[..., 2])
    between, within = inner & (height < 0.03), inner & (np.abs(height - 0.075) < 0.005)
    assert (block[between] < 0).all() and (found[between] > 0).mean() > 0.95
    assert (found[within] < 0).mean() > 0.95
    assert (found[inner & (height > 0.15)] > 0).all()


def test_far_from_points_the_field_stays_and_near_them_it_follows():
    """A ball seen from above only, and believed smaller."""
    points, normals, area = (x[sphere()[0][:, 2] > 0.2] for x in sphere())
    field = np.linalg.norm(GRID, axis=-1) - 0.32
    found = screened_poisson(field, LATTICE, points, normals, area, 0.1)
    far = (GRID[..., 2] < -0.15) & (np.abs(field) > STEP)
    assert ((found < 0) == (field < 0))[far].all()
    pole = found[N // 2, N // 2, N // 2 :]
    crossing = np.interp(0.0, pole[pole > -0.02], AXIS[N // 2 :][pole > -0.02])
    assert 0.333 < crossing < 0.355


def test_no_points_no_change():
    field = np.clip(np.linalg.norm(GRID, axis=-1) - 0.35, -TRANSITION_CELLS * STEP, TRANSITION_CELLS * STEP)
    points, normals, area = (x[:1] * 0 for x in sphere())
    found = screened_poisson(field, LATTICE, points, normals, area, 0.01)  # screened by far less than a cell
    assert ((found < 0) == (field < 0))[np.abs(field) > 0.5 * STEP].all()


def test_order_does_not_matter():
    field = np.full((N, N, N), 0.2)
    points, normals, area = sphere()
    shuffled = np.random.default_rng(3).permutation(len(points))
    one = screened_poisson(field, LATTICE, points, normals, area, LENGTH)
    other = screened_poisson(field, LATTICE, points[shuffled], normals[shuffled], area[shuffled], LENGTH)
    np.testing.assert_allclose(one, other, atol=1e-12)


def test_a_box_cut_out_of_the_grid_gives_the_same_within():
    """What lies a screening length off the points and the inside hardly matters."""
    field = np.linalg.norm(GRID, axis=-1) - 0.32
    whole = screened_poisson(field, LATTICE, *sphere(), LENGTH)
    level = GridField(LATTICE, field, field).around(field < 0.03, LENGTH)
    assert level.field.size < 0.9 * field.size
    cut = screened_poisson(level.field, level.lattice, *sphere(), LENGTH)
    first = np.rint((level.lattice.low + HALF) / STEP).astype(int)
    same = whole[tuple(slice(a, a + n) for a, n in zip(first, cut.shape, strict=True))]
    np.testing.assert_allclose(cut, same, atol=0.05 * STEP)


def test_splat_keeps_the_sum_and_the_mean_and_leaves_out_what_is_outside():
    rng = np.random.default_rng(0)
    points, value = rng.uniform(-0.5, 0.5, (100, 3)), rng.uniform(1, 2, 100)
    found, twice = splat(points, np.column_stack([value, 2 * value]), LATTICE)
    np.testing.assert_allclose(twice, 2 * found)
    found = found * STEP**3
    assert found.sum() == pytest.approx(value.sum())
    np.testing.assert_allclose(
        np.einsum("xyz,xyzi->i", found, GRID) / value.sum(), value @ points / value.sum(), atol=1e-9
    )
    assert splat(np.full((1, 3), 2.0), np.ones((1, 1)), LATTICE)[0].sum() == 0


def test_areas_sum_to_the_surface_and_the_other_face_of_a_board_does_not_count():
    points, normals, _ = sphere()
    assert surface_areas(points, normals, *KDTree(points).query(points, k=12)).sum() == pytest.approx(
        4 * np.pi * 0.35**2, rel=0.15
    )
    top, under = board(0.004, 1), board(0.0, -1)
    points, normals = (np.concatenate([a, b]) for a, b in zip(top[:2], under[:2], strict=True))
    assert surface_areas(points, normals, *KDTree(points).query(points, k=12)).sum() == pytest.approx(
        2 * 0.64, rel=0.2
    )


@pytest.mark.parametrize("share", [0.0, 0.02, 1.0])
def test_transforms_that_leave_out_what_is_empty_are_numpys(share):
    rng = np.random.default_rng(0)
    x, size = rng.normal(size=(9, 7, 8)) * (rng.random((9, 7, 1)) < share), [12, 10, 15]
    found = along_first(fourier(x, size), size)
    np.testing.assert_allclose(found, np.fft.rfftn(x, size, axes=(0, 1, 2)), atol=1e-4)
    np.testing.assert_allclose(inverse(found, size, x.shape), x, atol=1e-5)
