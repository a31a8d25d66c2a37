"""Poses between frames on the host (float64, 4×4, row-major), and how they compare."""

from __future__ import annotations

import jaxlie
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

Points = Float[np.ndarray, "_ 3"]  # clouds of one call differ in size
Matrix3 = Float[np.ndarray, "3 3"]
Pose = Float[np.ndarray, "4 4"]


def rotation_error_deg(R: Matrix3, R_true: Matrix3) -> float:
    """Angle of the rotation between two rotations: arccos((tr(Rᵀ R̄) − 1)/2), by a form that is exact near 0 too."""
    return float(np.rad2deg(Rotation.from_matrix(R.T @ R_true).magnitude()))


def apply_pose(T_a_b: Pose, points: Points) -> Points:
    """Points of frame b in frame a; float64."""
    return points @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def turned(T_a_b: Pose, normals: Points | None) -> Points | None:
    """Directions from frame b in frame a; None stays None."""
    return None if normals is None else normals @ T_a_b[:3, :3].T


def vertical_shift(height_m: float) -> Pose:
    """A shift along z, meters."""
    T = np.eye(4)
    T[2, 3] = height_m
    return T


def world_poses(
    local: jaxlie.SE3,
    target_origin: Float[np.ndarray, "*#batch 3"],
    source_origin: Float[np.ndarray, "*#batch 3"],
) -> Float[np.ndarray, "*poses 4 4"]:
    """Poses between the scans' own frames, from those between local frames about the given origins.

    Origins may be shared by several poses: they broadcast.
    """
    T = np.zeros((*local.wxyz_xyz.shape[:-1], 4, 4))
    quaternion, shift = np.split(on_host(local), (4,), axis=-1)
    R = Rotation.from_quat(quaternion.reshape(-1, 4), scalar_first=True).as_matrix()
    T[..., :3, :3] = R.reshape(*quaternion.shape[:-1], 3, 3)
    turned = np.einsum("...ij,...j->...i", T[..., :3, :3], source_origin)
    T[..., :3, 3] = shift + target_origin - turned
    T[..., 3, 3] = 1.0
    return T


def on_host(T: jaxlie.SE3) -> Float[np.ndarray, "*batch 7"]:
    """Quaternions (w, x, y, z) and translations of poses, float64.

    jaxlie's own accessors are programs, of which every number of poses would compile some.
    """
    return np.asarray(T.wxyz_xyz, np.float64)


def local_poses(
    T_target_source: Float[np.ndarray, "*batch 4 4"],
    target_origin: Float[np.ndarray, "*batch 3"],
    source_origin: Float[np.ndarray, "*batch 3"],
) -> jaxlie.SE3:
    """Poses between local frames about the given origins, float32; the inverse of `world_poses`."""
    R = T_target_source[..., :3, :3]
    turned = np.einsum("...ij,...j->...i", R, source_origin)
    shift = turned + T_target_source[..., :3, 3] - target_origin
    quaternion = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat(scalar_first=True, canonical=True)
    both = np.concatenate([quaternion.reshape(*R.shape[:-2], 4), shift], axis=-1)
    return jaxlie.SE3(both.astype(np.float32))  # type: ignore[arg-type]
