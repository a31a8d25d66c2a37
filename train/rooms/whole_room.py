"""A furnished room at one visit as one mesh: furniture, floor, walls and clutter, and what is whose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int

from train.rooms.depth_sensor import DepthSensor, Frame
from train.rooms.ray_scanner import PlacedMesh
from train.rooms.surroundings import Shape

BEHIND_M = 0.05  # a place this far behind the surface that hides it is still in sight
ON_SURFACE_M = 0.04  # a sample is seen where the pixel's depth is within so much of its own


@dataclass(frozen=True, kw_only=True)
class WholeRoom:
    """Everything that rays can hit, room's frame, meters."""

    mesh: trimesh.Trimesh
    owner: Int[np.ndarray, " f"]  # number of the object that each face belongs to; −1: none
    color: Float[np.ndarray, "f 3"]  # of each face, shares of red, green and blue


def whole_room(
    placed: Sequence[PlacedMesh], colors: Sequence[Float[np.ndarray, "f 3"]], shapes: Sequence[Shape]
) -> WholeRoom:
    """Joins furniture (with the colors of its faces) and unlabeled shapes."""
    parts = [(s.vertices, s.faces, -1, np.tile(s.color, (len(s.faces), 1))) for s in shapes]
    for k, (p, color) in enumerate(zip(placed, colors, strict=True)):
        parts.append((p.vertices @ p.T_room_model[:3, :3].T + p.T_room_model[:3, 3], p.faces, k, color))
    first = np.cumsum([0, *(len(v) for v, _, _, _ in parts)])
    faces = np.concatenate([f + start for (_, f, _, _), start in zip(parts, first[:-1], strict=True)])
    return WholeRoom(
        mesh=trimesh.Trimesh(np.concatenate([v for v, _, _, _ in parts]), faces, process=False),
        owner=np.concatenate([np.full(len(f), k) for _, f, k, _ in parts]),
        color=np.concatenate([c for _, _, _, c in parts]),
    )


def in_sight(
    points: Float[np.ndarray, "n 3"], frames: Sequence[Frame], sensor: DepthSensor
) -> Bool[np.ndarray, " n"]:
    """Which places (room's frame) some frame looked at: within range, with nothing well in front of them."""
    reached = np.zeros(len(points), bool)
    for frame in frames:
        z, pixel, inside = _projected(points, frame, sensor)
        reached |= inside & (frame.depth[pixel] > z - BEHIND_M)
    return reached


def seen_of(
    points: Float[np.ndarray, "n 3"], k: int, owner: np.ndarray, frames: Sequence[Frame], sensor: DepthSensor
) -> Bool[np.ndarray, " n"]:
    """Which samples of object k's surface (room's frame) some frame shows."""
    seen = np.zeros(len(points), bool)
    for frame in frames:
        z, pixel, inside = _projected(points, frame, sensor)
        face = frame.face[pixel]
        seen |= inside & (face >= 0) & (owner[face] == k) & (np.abs(frame.depth[pixel] - z) < ON_SURFACE_M)
    return seen


def _projected(
    points: np.ndarray, frame: Frame, sensor: DepthSensor
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth and pixel of each point, and whether the sensor can measure there."""
    T = frame.T_room_camera
    local = (points - T[:3, 3]) @ T[:3, :3]
    pixel, inside = sensor.pixel(local)
    z = local[:, 2]
    return z, pixel, inside & (z > sensor.nearest_m) & (z < sensor.farthest_m)
