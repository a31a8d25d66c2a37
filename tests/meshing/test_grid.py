"""Lattices by definition: where corners lie, half the step, boxes that hold what is kept, nearness to points."""

import numpy as np
import pytest
from scipy.ndimage import zoom
from scipy.spatial import cKDTree

from more2_jax.meshing.grid import GridField, crossed_corners, cube, surface_cells, upsampled


def test_a_cube_reaches_from_end_to_end_and_keeps_its_corners_when_finer():
    lattice = cube(4, 0.6)
    corners = lattice.corners().reshape(5, 5, 5, 3)
    axis = np.linspace(-0.6, 0.6, 5)
    np.testing.assert_allclose(corners, np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1))
    finer = lattice.finer()
    assert finer.shape == (9, 9, 9) and finer.step == lattice.step / 2
    np.testing.assert_allclose(finer.corners().reshape(9, 9, 9, 3)[::2, ::2, ::2], corners)


@pytest.mark.parametrize("distance", [0.0, 0.05, 0.2])
def test_every_corner_so_near_to_a_point_is_near(distance):
    lattice = cube(24, 0.5)
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (30, 3))  # some are outside
    points = points[np.abs(points).max(axis=1) < 0.5]
    corners = lattice.corners()
    apart = cKDTree(points).query(corners)[0]
    near = lattice.corners_near(points, distance).ravel()
    assert near[apart <= distance].all()
    assert (apart[near] <= np.sqrt(3) * (distance + 2 * lattice.step)).all()


@pytest.mark.parametrize("margin", [0.0, 0.1, 5.0])
def test_a_box_holds_what_is_kept_and_its_margin(margin):
    lattice = cube(20, 0.5)
    values = np.random.default_rng(0).normal(size=lattice.shape)
    kept = np.linalg.norm(lattice.corners() - [0.2, 0, -0.1], axis=1).reshape(lattice.shape) < 0.15
    level = GridField(lattice, values, 2 * values).around(kept, margin)
    assert level.field.shape == level.values.shape == level.lattice.shape
    held, whole = level.lattice.corners(), lattice.corners()
    wanted = np.abs(whole - [0.2, 0, -0.1]).max(axis=1) < 0.15 - lattice.step + margin
    assert cKDTree(held).query(whole[wanted])[0].max() < 1e-9
    assert (len(held) < len(whole)) == (margin < 1)
    row = cKDTree(whole).query(held)[1]
    np.testing.assert_array_equal(level.field.ravel(), values.ravel()[row])
    np.testing.assert_array_equal(level.values.ravel(), 2 * values.ravel()[row])


def test_the_box_of_nothing_is_all():
    lattice = cube(4, 0.5)
    level = GridField(lattice, np.ones(lattice.shape), np.ones(lattice.shape))
    assert level.around(np.zeros(lattice.shape, bool), 0.1) is level


def test_cells_that_the_surface_may_pass_are_looked_into():
    axis = np.linspace(-1, 1, 9)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    near = surface_cells(np.linalg.norm(grid - [0.1, 0.1, 0.1], axis=-1) - 0.05, 0.25)  # between all corners
    assert near[4, 4, 4]
    assert not near[0].any() and near.sum() < 30


def test_half_the_step_is_linear_interpolation():
    x = np.random.default_rng(0).normal(size=(5, 5, 5))
    np.testing.assert_allclose(upsampled(x), zoom(x, 9 / 5, order=1, grid_mode=False), atol=1e-12)


def test_crossed_corners_are_those_of_cells_whose_corners_differ_in_sign():
    values = np.random.default_rng(0).choice([-1.0, 0.0, 1.0], (6, 5, 4), p=[0.1, 0.05, 0.85])
    expected = np.zeros(values.shape, bool)
    for cell in np.ndindex(5, 4, 3):
        box = tuple(slice(c, c + 2) for c in cell)
        inside = values[box] < 0
        expected[box] |= inside.any() and not inside.all()
    assert 0 < expected.sum() < expected.size
    np.testing.assert_array_equal(crossed_corners(values), expected)
