"""Local outlier factors: flying pixels have large ones, surfaces none, whatever the frame, the unit and the density."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from more2_jax.geometry.outliers import NEIGHBORS, inliers, outlier_factors


def sheet(count=2000, seed=0):
    p = np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 3))
    p[:, 2] = 0.0
    return p


def test_points_off_a_surface_are_told_from_it():
    flying = np.random.default_rng(1).uniform([-0.4, -0.4, 0.1], [0.4, 0.4, 0.4], (15, 3))
    found = outlier_factors(np.concatenate([sheet(), flying]))
    assert (found[:2000] < 1.5).mean() > 0.99 and (found[2000:] > 1.5).all()
    np.testing.assert_array_equal(inliers(np.concatenate([sheet(), flying]), 1.5), found <= 1.5)


def test_a_sparse_part_is_none():
    """A surface far from the sensor: a tenth of the points on as much of it."""
    points = np.concatenate([sheet(4000), sheet(400, 1) + [2.0, 0, 0]])
    assert inliers(points, 1.5)[4000:].mean() > 0.97


def test_by_definition():
    points = np.random.default_rng(2).normal(size=(60, 3))
    distance = np.linalg.norm(points[:, None] - points, axis=2)
    near = np.argsort(distance, axis=1)[:, 1 : NEIGHBORS + 1]
    own = np.take_along_axis(distance, near, axis=1).mean(axis=1)
    np.testing.assert_allclose(outlier_factors(points), own / own[near].mean(axis=1))


def test_frame_unit_and_order_do_not_matter():
    points = np.random.default_rng(3).normal(size=(500, 3)) * [1, 1, 0.1]
    moved = 0.01 * points @ Rotation.random(random_state=1).as_matrix().T + [5.0, -3.0, 1.0]
    order = np.random.default_rng(4).permutation(500)
    np.testing.assert_allclose(outlier_factors(moved), outlier_factors(points), rtol=1e-6)
    np.testing.assert_allclose(outlier_factors(points[order]), outlier_factors(points)[order])


@pytest.mark.parametrize(
    "points",
    [np.zeros((0, 3)), np.eye(3), np.zeros((100, 3)), np.repeat(sheet(20), 50, axis=0)],
    ids=["none", "few", "one place", "doubled"],
)
def test_too_few_or_doubled_points_are_no_outliers(points):
    assert (outlier_factors(points) == 1).all() and inliers(points, 1.5).all()


def test_without_a_limit_all_count():
    assert inliers(np.random.default_rng(5).normal(size=(99, 3)), 0.0).all()
