"""Where objects stand in a room: no two touch, all rest on the floor, and those that move do move."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from train.rooms.ray_scanner import Pose, footprint_radius, free_spot

TRIES = 500
DENSEST = 1.0  # share of the floor that circles cannot exceed
Circle = tuple[float, float, float]  # x, y, radius, meters
DECIMALS = 9  # of a pose: last bits, which differ between processors, are gone


def arrange(
    present: Mapping[str, Float[np.ndarray, "v 3"]],
    before: Mapping[str, Pose],
    static: Collection[str],
    room_m: tuple[float, float],
    rng: np.random.Generator,
    *,
    free: bool = False,
    moved_m: tuple[float, float] = (0.3, np.inf),
) -> dict[str, Pose]:
    """A pose in the room for the vertices of every object present, none touching another.

    Static objects stay where they were `before`; the others come to stand `moved_m` (least, most) from there.
    Raises ValueError when the room is too full.
    """
    if not free:
        _check_room([footprint_radius(v) for v in present.values()], room_m)
    for _ in range(TRIES):
        poses = {n: before[n] for n in present if n in static and n in before}
        taken = [circle(present[n], p, free) for n, p in poses.items()]
        try:
            for n in (n for n in present if n not in poses):
                poses[n] = _pose(present[n], taken, room_m, rng, free)
                taken.append(circle(present[n], poses[n], free))
        except ValueError:
            continue
        moved = [n for n in present if n in before and n not in static]
        if all(moved_m[0] < np.linalg.norm(poses[n][:2, 3] - before[n][:2, 3]) < moved_m[1] for n in moved):
            return poses
    raise ValueError(
        f"no arrangement of {len(present)} objects in {room_m[0]} × {room_m[1]} m; needed more room"
    )


def _check_room(radii: Sequence[float], room_m: tuple[float, float]) -> None:
    """Raises ValueError if no arrangement of the circles exists, so that none is looked for."""
    area = np.pi * sum(r * r for r in radii)
    if 2 * max(radii, default=0.0) > min(room_m) or area > DENSEST * room_m[0] * room_m[1]:
        raise ValueError(
            f"{len(radii)} objects on {area:.1f} m², the largest {2 * max(radii):.2f} m across, in"
            f" {room_m[0]} × {room_m[1]} m; needed more room"
        )


def circle(vertices: Float[np.ndarray, "v 3"], pose: Pose, free: bool) -> Circle:
    """The circle on the floor that holds an object: about its origin if it stands upright, else about its box."""
    offset, radius = _footing(vertices, pose[:3, :3], free)
    x, y = pose[:2, 3] + offset
    return float(x), float(y), radius


def _footing(
    vertices: Float[np.ndarray, "v 3"], R: Float[np.ndarray, "3 3"], free: bool
) -> tuple[Float[np.ndarray, " 2"], float]:
    """Middle, from the origin, and radius of the circle of a turned object."""
    if not free:
        return np.zeros(2), footprint_radius(vertices)
    below = vertices @ R.T[:, :2]
    middle = (below.min(axis=0) + below.max(axis=0)) / 2
    return middle, float(np.linalg.norm(below - middle, axis=1).max())


def _pose(
    vertices: Float[np.ndarray, "v 3"],
    taken: list[Circle],
    room_m: tuple[float, float],
    rng: np.random.Generator,
    free: bool,
) -> Pose:
    """Turned at random and resting on the floor, clear of what is `taken`."""
    turn = (
        Rotation.from_quat(rng.normal(size=4))
        if free
        else Rotation.from_euler("z", rng.uniform(0, 2 * np.pi))
    )
    pose = np.eye(4)
    pose[:3, :3] = np.round(turn.as_matrix(), DECIMALS)
    offset, radius = _footing(vertices, pose[:3, :3], free)
    pose[:2, 3] = np.round(free_spot(rng, radius, taken, room_m) - offset, DECIMALS)
    if free:
        pose[2, 3] = np.round(-(vertices @ pose[2, :3]).min(), DECIMALS)
    return pose
