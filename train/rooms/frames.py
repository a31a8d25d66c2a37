"""The frame that a scan's coordinates are in: of its own, as a device starts, or nearly that of the other scans."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

Frames = Literal["own", "aligned"]
SHIFT_M = 3.0  # of an own frame, most along each axis
TILT_DEG = 5.0  # of an own frame against gravity, at most
NEAR_M, NEAR_DEG = 0.05, 1.0  # two aligned frames differ by at most so much, in the room's middle


def scan_frames(kind: Frames, scans: int, rng: np.random.Generator) -> Float[np.ndarray, "scans 4 4"]:
    """T_scan_room of every scan; `own`: any yaw, meters apart, tilted; `aligned`: one frame but for a little."""
    common = _frame(rng.uniform(0, 360), 0.0, rng.uniform(-SHIFT_M, SHIFT_M, 3), rng)
    frames = []
    for _ in range(scans):
        if kind == "own":
            shift = rng.uniform(-SHIFT_M, SHIFT_M, 3) * [1, 1, 0.5]
            frames.append(_frame(rng.uniform(0, 360), rng.uniform(0, TILT_DEG), shift, rng))
        else:
            shift = _direction(rng) * rng.uniform(0, NEAR_M / 2)
            turn = Rotation.from_rotvec(_direction(rng) * rng.uniform(0, NEAR_DEG / 2), degrees=True)
            little = np.eye(4)
            little[:3, :3], little[:3, 3] = turn.as_matrix(), shift
            frames.append(common @ little)
    return np.round(np.stack(frames), 12)


def _frame(yaw_deg: float, tilt_deg: float, shift_m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A frame turned about the vertical, then tilted about any level axis, then shifted."""
    angle = rng.uniform(0, 2 * np.pi)
    tilt = Rotation.from_rotvec(tilt_deg * np.array([np.cos(angle), np.sin(angle), 0]), degrees=True)
    T = np.eye(4)
    T[:3, :3] = (tilt * Rotation.from_euler("z", yaw_deg, degrees=True)).as_matrix()
    T[:3, 3] = shift_m
    return T


def _direction(rng: np.random.Generator) -> np.ndarray:
    """A unit vector, any direction equally likely."""
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)
