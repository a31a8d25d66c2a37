"""Points by cells: nothing near or in view is missed, each comes once, and most of what is not is left out."""

import numpy as np
import pytest

from more2_jax.geometry.free_space import axes_toward
from more2_jax.geometry.near_points import CELL_M, RADIUS_M, NearClouds, NearPoints, rms_radius

POINTS = np.random.default_rng(0).uniform(-20, 20, (20_000, 3))


def missed(wanted, found):
    assert len(np.unique(found, axis=0)) == len(found)
    return set(map(tuple, wanted)) - set(map(tuple, found))


@pytest.mark.parametrize("reach_m", [0.5, 4.0, 1000.0])
@pytest.mark.parametrize("place", [(0.0, 0, 0), (-19.9, 3, 20), (70.0, 0, 0)])
def test_what_is_within_reach_comes_once_and_what_is_not_stays(reach_m, place):
    near = NearPoints(POINTS)
    found = near.points_of(near.cells_around(np.array(place), reach_m))
    distance = np.linalg.norm(POINTS - place, axis=1)
    assert missed(POINTS[distance <= reach_m], found) == set()
    assert (np.linalg.norm(found - place, axis=1) <= reach_m + 2 * RADIUS_M).all()


@pytest.mark.parametrize("half", [0.05, 0.4, 3.0])
def test_what_is_in_view_comes_once_and_most_else_stays(half):
    near, rng = NearPoints(POINTS), np.random.default_rng(1)
    every = near.cells_around(np.zeros(3), 100.0)
    for _ in range(5):
        eye, turn = rng.uniform(-15, 15, 3), axes_toward(rng.normal(size=3))
        x, y, z = ((POINTS - eye) @ turn.T).T
        visible = (z > 0) & (np.maximum(np.abs(x), np.abs(y)) <= half * z)
        found = near.in_view(every, eye, turn[2], half)
        assert missed(POINTS[visible], found) == set()
        assert len(found) < len(POINTS) and (half > 1 or len(found) < len(POINTS) / 2)


@pytest.mark.parametrize("size", [0.0, 0.7, 5.0, 100.0])
def test_around_a_box_all_of_it_comes_in_the_order_given_and_little_else(size):
    near = NearPoints(POINTS)
    for low in np.random.default_rng(1).uniform(-22, 20, (20, 3)):
        found = near.around_box(low, low + size)
        kept = ((found >= low) & (found <= low + size)).all(axis=1)
        wanted = ((low <= POINTS) & (low + size >= POINTS)).all(axis=1)
        np.testing.assert_array_equal(found[kept], POINTS[wanted])
        assert ((found >= low - CELL_M) & (found <= low + size + CELL_M)).all()
        np.testing.assert_array_equal(POINTS[near.rows_around_box(low, low + size)], found)


def test_of_no_points_none_are_near():
    near = NearPoints(np.zeros((0, 3)))
    assert near.points_of(near.cells_around(np.zeros(3), 5.0)).shape == (0, 3)
    assert near.around_box(np.zeros(3), np.ones(3)).shape == (0, 3)
    assert not len(near.rows_around_box(np.zeros(3), np.ones(3)))


def test_clouds_near_some_places_show_there_what_all_clouds_show():
    """A building of 400 balls: what is put in order is near the places, and all that is near is."""
    rng = np.random.default_rng(4)
    middles = np.stack([*np.meshgrid(*[np.arange(20) * 5.0] * 2), np.zeros((20, 20))], axis=-1).reshape(-1, 3)
    clouds = [m + rng.normal(0, 0.7, (50, 3)) for m in middles] + [np.zeros((0, 3))]
    rest = rng.uniform(0, 95, (300, 3))
    whole = NearPoints(np.concatenate([*clouds, rest]))
    building = NearClouds([lambda c=c: c for c in clouds], rest)
    for places in ([middles[0]], [middles[0]], [middles[45], middles[47]], [np.array([-500.0, 0, 0])]):
        some = building.near(places, 8.0)
        for place in places:
            here, expected = (x.points_of(x.cells_around(place, 8.0)) for x in (some, whole))
            assert len(here) == len(expected) and missed(expected, here) == set()
        everything = some.around_box(np.full(3, -1e3), np.full(3, 1e3))
        assert len(everything) < 60 * 50 + len(rest) / 10
    assert building.near(places, 8.0) is some
    assert len(building.near([], 8.0).around_box(np.full(3, -1e3), np.full(3, 1e3))) < len(rest) / 10


def test_the_radius_of_a_cloud_is_that_of_a_ball_whose_surface_it_covers_wherever_it_lies():
    points = np.random.default_rng(3).normal(size=(20_000, 3))
    sphere = 0.7 * points / np.linalg.norm(points, axis=1, keepdims=True)
    assert rms_radius(sphere) == pytest.approx(0.7, rel=1e-3)
    assert rms_radius(sphere + 50) == pytest.approx(rms_radius(sphere), rel=1e-9)
    assert rms_radius(np.full((5, 3), 2.0)) == 0
