"""Points near a cloud: all of them and no others, in their order."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from more2_jax.geometry.near_points import NearPoints
from more2_jax.geometry.room_planes import within


@pytest.mark.parametrize("reach", [0.2, 0.5, 3.0])
@pytest.mark.parametrize("shift", [0.0, 1e3])
def test_within_holds_what_distances_say(reach, shift):
    rng = np.random.default_rng(0)
    cloud, points = rng.normal(size=(200, 3)) + shift, rng.uniform(-4, 4, (3000, 3)) + shift
    distance = np.linalg.norm(points[:, None] - cloud, axis=-1).min(axis=1)
    for asked in (points, NearPoints(points)):
        np.testing.assert_array_equal(within(KDTree(cloud), asked, reach), points[distance < reach])
    assert 0 < (distance < reach).sum() < len(points)


def test_nothing_is_near_nothing():
    assert within(KDTree(np.zeros((1, 3))), np.zeros((0, 3)), 1.0).shape == (0, 3)
    assert within(KDTree(np.zeros((1, 3))), np.full((5, 3), 9.0), 1.0).shape == (0, 3)
