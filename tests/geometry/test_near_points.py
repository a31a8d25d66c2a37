"""Points by cells: nothing within reach is missed, each comes once, and most of what is far off is left out."""

import numpy as np
import pytest

from more2_jax.geometry.near_points import NearPoints


@pytest.mark.parametrize("reach_m", [0.5, 4.0, 1000.0])
def test_what_is_within_reach_comes_once_and_most_else_stays(reach_m):
    points = np.random.default_rng(0).uniform(-20, 20, (5000, 3))
    near = NearPoints(points, reach_m)
    for place in (np.zeros(3), np.array([-19.9, 3.0, 20.0]), np.array([70.0, 0, 0])):
        found = near.around(place)
        assert len(np.unique(found, axis=0)) == len(found)
        distance = np.linalg.norm(points - place, axis=1)
        missed = set(map(tuple, points[distance <= reach_m])) - set(map(tuple, found))
        assert missed == set()
        assert (np.linalg.norm(found - place, axis=1) <= reach_m * 4 / 3 * np.sqrt(3)).all()


def test_of_no_points_none_are_near():
    assert NearPoints(np.zeros((0, 3)), 1.0).around(np.zeros(3)).shape == (0, 3)
