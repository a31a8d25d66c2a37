"""Poses on points and the angle between rotations, against the definitions."""

import itertools
import math

import numpy as np
import pytest
from scipy.linalg import logm
from scipy.spatial.transform import Rotation

from more2_jax.geometry.poses import apply_pose, rotation_error_deg


def turn(axis, degrees):
    return Rotation.from_rotvec(np.deg2rad(degrees) * np.asarray(axis, float)).as_matrix()


def test_rotation_error_is_the_length_of_the_matrix_logarithm():
    for a, b in itertools.pairwise(Rotation.random(20, random_state=1).as_matrix()):
        expected = np.rad2deg(np.linalg.norm(logm(a.T @ b)) / math.sqrt(2))
        assert rotation_error_deg(a, b) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("degrees", [0.0, 1e-7, 1e-3, 1.0, 90.0, 179.9999, 180.0])
def test_rotation_error_is_exact_at_both_ends(degrees):
    # arccos of the trace loses half of all digits near 0 and near 180°.
    assert rotation_error_deg(turn([0, 1, 0], degrees), np.eye(3)) == pytest.approx(degrees, abs=1e-9)


def test_apply_pose_is_the_homogeneous_product():
    T, cloud = np.eye(4), np.random.default_rng(0).normal(size=(60, 3))
    T[:3, :3], T[:3, 3] = turn([0, 0, 1], 40), [0.5, -1, 2]
    np.testing.assert_allclose(apply_pose(T, cloud), [(T @ [*p, 1.0])[:3] for p in cloud], atol=1e-12)
