"""TODO"""

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


def world_pose(
    T_target_source: jaxlie.SE3, target_origin: Float[np.ndarray, "3"], source_origin: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """The pose between the scans' own frames, float64 row-major, from a local one."""
    quaternion = np.asarray(T_target_source.rotation().wxyz, np.float64)
    rotation = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = (
        np.asarray(T_target_source.translation(), np.float64) + target_origin - rotation @ source_origin
    )
    return pose


def in_frames(
    local: jaxlie.SE3, target_origin: Float[np.ndarray, "p 3"], source_origin: Float[np.ndarray, "p 3"]
) -> Float[np.ndarray, "p h 4 4"]:
    """Poses between local frames as poses between the frames of the clouds, float64."""
    q = np.asarray(local.rotation().wxyz, np.float64)
    T = np.tile(np.eye(4), (*q.shape[:2], 1, 1))
    R = Rotation.from_quat(q.reshape(-1, 4), scalar_first=True).as_matrix().reshape(*q.shape[:2], 3, 3)
    shift = np.asarray(local.translation(), np.float64)
    T[..., :3, :3] = R
    T[..., :3, 3] = shift + target_origin[:, None] - np.einsum("phij,pj->phi", R, source_origin)
    return T


def local_pose(T_ref_scan: Pose, ref_origin: np.ndarray, scan_origin: np.ndarray) -> np.ndarray:
    """The pose between local frames, as jaxlie's (qw, qx, qy, qz, x, y, z)."""
    shift = apply_pose(T_ref_scan, scan_origin[None])[0] - ref_origin
    quaternion = Rotation.from_matrix(T_ref_scan[:3, :3]).as_quat(canonical=True, scalar_first=True)
    return np.concatenate([quaternion, shift])
