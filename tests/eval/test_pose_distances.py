"""Distances between poses on points, against slow computations."""

import math

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from eval.scores.pose_distances import (
    as_published_rmse,
    modified_chamfer,
    modified_chamfer_distance,
    transformation_rmse,
)

RNG = np.random.default_rng(0)
CLOUD = RNG.normal(size=(60, 3))
OTHER = RNG.normal(size=(45, 3))


def turn(axis, degrees):
    return Rotation.from_rotvec(np.deg2rad(degrees) * np.asarray(axis, float)).as_matrix()


def pose(rotation, translation):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation
    return T


T_TRUE = pose(turn([0, 0, 1], 40), [0.5, -1, 2])
T_NEAR = pose(turn([0, 0.6, 0.8], 43), [0.52, -1.1, 2])


def moved(T, points):
    return np.array([(T @ [*p, 1.0])[:3] for p in points])


def test_rmse_is_the_root_of_the_mean_square_over_both_directions():
    square = [sum((a - b) ** 2) for a, b in zip(moved(T_NEAR, CLOUD), moved(T_TRUE, CLOUD), strict=True)]
    back = moved(np.linalg.inv(T_NEAR), OTHER), moved(np.linalg.inv(T_TRUE), OTHER)
    square += [sum((a - b) ** 2) for a, b in zip(*back, strict=True)]
    expected = math.sqrt(sum(square) / len(square))
    assert transformation_rmse(T_NEAR, T_TRUE, CLOUD, OTHER) == pytest.approx(expected)
    assert transformation_rmse(T_TRUE, T_TRUE, CLOUD, OTHER) == 0


def test_a_pure_shift_is_its_own_rmse_and_the_published_one_is_a_root_of_three_less():
    shifted = pose(np.eye(3), [1, 1, 1])
    assert transformation_rmse(shifted, np.eye(4), CLOUD, OTHER) == pytest.approx(math.sqrt(3))
    assert as_published_rmse(shifted, np.eye(4), CLOUD, OTHER) == pytest.approx(1)


def test_modified_chamfer_against_all_distances():
    whole_target = np.concatenate([OTHER, moved(T_TRUE, CLOUD)])
    whole_source = np.concatenate([CLOUD, moved(np.linalg.inv(T_TRUE), OTHER)])
    there = cdist(moved(T_NEAR, CLOUD), whole_target, "sqeuclidean").min(axis=1).mean()
    back = cdist(moved(np.linalg.inv(T_NEAR), OTHER), whole_source, "sqeuclidean").min(axis=1).mean()
    assert modified_chamfer(T_NEAR, T_TRUE, CLOUD, OTHER) == pytest.approx(there + back)


def test_modified_chamfer_of_the_true_pose_is_zero_though_the_clouds_overlap_nowhere():
    assert modified_chamfer(T_TRUE, T_TRUE, CLOUD, OTHER + 100) == pytest.approx(0, abs=1e-20)


def test_the_chamfer_that_is_not_squared_is_the_mean_of_both_ways():
    whole_target = np.concatenate([OTHER, moved(T_TRUE, CLOUD)])
    whole_source = np.concatenate([CLOUD, moved(np.linalg.inv(T_TRUE), OTHER)])
    there = cdist(moved(T_NEAR, CLOUD), whole_target).min(axis=1).mean()
    back = cdist(moved(np.linalg.inv(T_NEAR), OTHER), whole_source).min(axis=1).mean()
    assert modified_chamfer_distance(T_NEAR, T_TRUE, CLOUD, OTHER) == pytest.approx((there + back) / 2)
