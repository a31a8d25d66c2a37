"""Rooms laid onto one another: every way in which they fit is listed, half turns with it, whichever was begun from."""

import numpy as np
import pytest
from factories import turn_z
from furnished_room import empty_room, furnished_room

from more2_jax.geometry.gravity import gravity
from more2_jax.geometry.poses import apply_pose
from more2_jax.geometry.room_alignment import fit_as_given, fit_from_any_yaw, fits_from_any_yaw, room_shape

AWAY = turn_z(np.deg2rad(67.0), np.zeros(3), np.array([5.0, -3.0, 0.4]))
SIDES_M = (5.0, 3.6)
HALF_TURN = turn_z(np.pi, np.array([SIDES_M[0] / 2, SIDES_M[1] / 2, 0.0]), np.zeros(3))


def shapes(first, second, T_b_a):
    """Both as they are compared, the second seen from a frame of its own."""
    a, b = room_shape(first), room_shape(apply_pose(T_b_a, second))
    assert a is not None and b is not None
    return a, b


def off_m(T_a_b, expected, points) -> float:
    return np.linalg.norm(apply_pose(T_a_b, points) - apply_pose(expected, points), axis=1).mean()


def test_furniture_tells_a_room_from_itself_turned_by_half_a_turn():
    a, b = shapes(furnished_room(SIDES_M, 0), furnished_room(SIDES_M, 1), AWAY)
    true = np.linalg.inv(AWAY)
    first, *others = fits_from_any_yaw(a, b)
    assert off_m(first.T_a_b, true, b.points) < 0.02
    assert any(off_m(f.T_a_b, HALF_TURN @ true, b.points) < 0.1 for f in others)
    assert all(f.closeness <= first.closeness for f in others)
    only = fit_from_any_yaw(a, b)
    assert only is not None and np.array_equal(only.T_a_b, first.T_a_b)
    assert fit_as_given(a, b) is None


def test_an_empty_rectangular_room_fits_both_ways_and_none_is_taken():
    a, b = shapes(empty_room(SIDES_M, 0), empty_room(SIDES_M, 1), AWAY)
    fits = fits_from_any_yaw(a, b)
    true = np.linalg.inv(AWAY)
    for expected in (true, HALF_TURN @ true):
        assert min(off_m(f.T_a_b, expected, b.points) for f in fits) < 0.03
    assert fit_from_any_yaw(a, b) is None


@pytest.mark.parametrize("given", [np.eye(4), turn_z(0.03, np.zeros(3), np.array([0.05, -0.1, 0.0]))])
def test_scans_in_one_frame_fit_as_they_are_given(given):
    a, b = shapes(furnished_room(SIDES_M, 0), furnished_room(SIDES_M, 1), given)
    fit = fit_as_given(a, b)
    assert fit is not None and off_m(fit.T_a_b, np.linalg.inv(given), b.points) < 0.02


def test_a_room_whose_floor_is_too_bent_to_level_it_is_laid_on_by_all_else():
    first = furnished_room(SIDES_M, 0)
    low = first[:, 2] < 0.1
    first[low, 2] += 0.1 * np.sin(2.0 * first[low, 0]) * np.cos(3.0 * first[low, 1])
    a, b = shapes(first, furnished_room(SIDES_M, 1), AWAY)
    assert gravity(a.points) is None
    fit = fit_from_any_yaw(a, b)
    assert fit is not None and off_m(fit.T_a_b, np.linalg.inv(AWAY), b.points) < 0.1
