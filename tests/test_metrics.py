"""Distances of poses and surfaces against slow, independent computations; each has a case of zero and one of more."""

import itertools

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from more2_jax import metrics

RNG = np.random.default_rng(0)
CLOUD = RNG.normal(size=(60, 3))
OTHER = RNG.normal(size=(45, 3))


def turn(axis, degrees):
    return Rotation.from_rotvec(np.deg2rad(degrees) * np.asarray(axis, float)).as_matrix()


# --- rotations ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("order", "expected"), [(1, 170), (2, 10), (3, 50), (4, 10), (0, 0)])
def test_symmetric_error_is_the_least_over_the_group(order, expected):
    error = metrics.symmetry_aware_rotation_error_deg(
        turn([0, 0, 1], 170), np.eye(3), np.array([0, 0, 3.0]), order
    )
    assert error == pytest.approx(expected, abs=1e-6)


def test_any_turn_is_the_limit_of_a_high_order():
    axis = np.array([0.6, 0, 0.8])
    for R, R_true in itertools.pairwise(Rotation.random(8, random_state=2).as_matrix()):
        least = metrics.symmetry_aware_rotation_error_deg(R, R_true, axis, 0)
        assert least == pytest.approx(
            metrics.symmetry_aware_rotation_error_deg(R, R_true, axis, 1440), abs=0.2
        )


def test_symmetry_acts_in_the_frame_of_the_source():
    R_true = turn([1, 0, 0], 90)
    symmetric = R_true @ turn([0, 0, 1], 180)
    assert metrics.symmetry_aware_rotation_error_deg(symmetric, R_true, np.array([0, 0, 1.0]), 2) < 1e-6
    tipped = turn([0, 0, 1], 180) @ R_true
    assert metrics.symmetry_aware_rotation_error_deg(tipped, R_true, np.array([0, 0, 1.0]), 2) > 90


def test_tipping_over_is_an_error_whatever_the_symmetry():
    for order in (0, 1, 2, 7):
        error = metrics.symmetry_aware_rotation_error_deg(
            turn([1, 0, 0], 90), np.eye(3), np.array([0, 0, 1.0]), order
        )
        assert error == pytest.approx(90, abs=1e-6)


def test_negative_symmetry_order_is_refused():
    with pytest.raises(ValueError, match="symmetry order -1"):
        metrics.symmetry_aware_rotation_error_deg(np.eye(3), np.eye(3), np.array([0, 0, 1.0]), -1)


# --- surfaces and solids --------------------------------------------------------------------------------------


def test_chamfer_against_all_distances():
    distances = cdist(CLOUD, OTHER)
    accuracy, completeness = distances.min(axis=1).mean(), distances.min(axis=0).mean()
    assert metrics.accuracy(CLOUD, OTHER) == pytest.approx(accuracy)
    assert metrics.completeness(CLOUD, OTHER) == pytest.approx(completeness)
    assert metrics.chamfer_l1(CLOUD, OTHER) == pytest.approx((accuracy + completeness) / 2)
    assert metrics.chamfer_l1(CLOUD, CLOUD[::-1]) == 0


def test_a_part_is_accurate_but_not_complete():
    assert metrics.accuracy(CLOUD[:10], CLOUD) == 0
    assert metrics.completeness(CLOUD[:10], CLOUD) > 0.1
