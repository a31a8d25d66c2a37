"""How far surfaces of two scans lie apart that both show: noise of sensors, and drift of what carried them.

Beyond the paper. What still stands where it stood lies as near as that, be it three centimeters or eight.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from more2_jax.geometry.poses import Points, apply_pose
from more2_jax.geometry.room_alignment import RoomShape
from more2_jax.types import Frame

REACH_M = 0.15  # what is farther from a surface is none of it
SHARE = 0.68  # of the points of one scan about the other's surfaces: one standard deviation
LEAST_POINTS = 200  # of these that tell
MOST_POINTS = 4000  # of a scan, at even steps
# So near, at least, lies what fusion and drift leave of one surface: rooms of regime `real` have 0.9 to 1.2 cm of
# noise; and so many times the noise where there is more, up to the last: docs/developing/notebook/scan_noise.md.
NEAR_M, NOISES, FARTHEST_M = 0.03, 2.5, 0.08


def near_m(noise_m: float) -> float:
    """How near one surface lies to itself in two scans, meters."""
    return min(max(NEAR_M, NOISES * noise_m), FARTHEST_M)


def with_noise(frame: Frame, scene: RoomShape | None, scan: Points) -> Frame:
    """The frame of a scan, with how far its background lies off that of the scene in it; 0 where that is not known."""
    if scene is None or frame.unknown:
        return dataclasses.replace(frame, noise_m=0.0)
    return dataclasses.replace(frame, noise_m=noise_off(scene, apply_pose(frame.T_scene_scan, scan)))


def noise_off(surfaces: RoomShape, points: Points) -> float:
    """Distance from the surfaces of a scan within which `SHARE` of another's points lie that show them; meters.

    Both in one frame. 0 where they share too little.
    """
    points = points[:: max(1, -(-len(points) // MOST_POINTS))]
    distance, near = map(np.asarray, surfaces.tree.query(points, distance_upper_bound=REACH_M))
    on = np.isfinite(distance)
    if on.sum() < LEAST_POINTS:
        return 0.0
    off = points[on] - surfaces.points[near[on]]
    return float(np.quantile(np.abs(np.einsum("ni,ni->n", off, surfaces.normals[near[on]])), SHARE))
