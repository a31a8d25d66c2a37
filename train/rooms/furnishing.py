"""Where furniture stands in a lived-in room: upright, near walls or free, close to its neighbors, none in another."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from train.rooms.arrangement import DECIMALS
from train.rooms.ray_scanner import Pose

TRIES, PLACES = 60, 200  # arrangements, and places for one object in each
AT_WALL = 0.55  # share of the objects that stand with a side to a wall
GAP_M = (0.02, 0.12)  # between such an object and its wall
APART_M = 0.04  # between any two objects, at least
FULLEST = 0.7  # share of the floor under boxes about furniture, beyond which nothing is tried
MOVED_M = 0.3  # what moves comes to stand at least so far from where it was

Corners = Float[np.ndarray, "4 2"]


def furnish(
    present: Mapping[str, Float[np.ndarray, "v 3"]],
    before: Mapping[str, Pose],
    static: Collection[str],
    room_m: tuple[float, float],
    rng: np.random.Generator,
) -> dict[str, Pose]:
    """A pose in the room for the vertices (meters, standing on z = 0) of every object present.

    Static objects stay where they were `before`; the others move. Raises ValueError when the room is too full.
    """
    boxes = {n: _footprint(v) for n, v in present.items()}
    full = ValueError(
        f"no place for {len(present)} objects in {room_m[0]:.1f} × {room_m[1]:.1f} m; needed more room"
    )
    if sum(float(np.ptp(b, axis=0).prod()) for b in boxes.values()) > FULLEST * room_m[0] * room_m[1]:
        raise full
    largest_first = sorted(present, key=lambda n: -float(np.ptp(boxes[n], axis=0).prod()))
    for _ in range(TRIES):
        poses = {n: before[n] for n in present if n in static and n in before}
        for n in (n for n in largest_first if n not in poses):
            taken = [_turned(boxes[m], p) for m, p in poses.items()]
            if (pose := _free_pose(boxes[n], taken, before.get(n), room_m, rng)) is None:
                break
            poses[n] = pose
        else:
            return {n: poses[n] for n in present}
    raise full


def _footprint(vertices: Float[np.ndarray, "v 3"]) -> Corners:
    """Corners of the box about an object, seen from above, in order around it."""
    (x0, y0), (x1, y1) = vertices[:, :2].min(axis=0), vertices[:, :2].max(axis=0)
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def _turned(box: Corners, pose: Pose) -> Corners:
    return box @ pose[:2, :2].T + pose[:2, 3]


def _free_pose(
    box: Corners,
    taken: Collection[Corners],
    before: Pose | None,
    room_m: tuple[float, float],
    rng: np.random.Generator,
) -> Pose | None:
    """A pose clear of what is taken and elsewhere than before; None if none is found."""
    at_wall = rng.random() < AT_WALL
    for k in range(PLACES):
        pose = _proposal(box, at_wall and k < PLACES // 2, room_m, rng)
        if pose is None or (before is not None and np.hypot(*(pose - before)[:2, 3]) < MOVED_M):
            continue
        if not any(overlap(_turned(box, pose), other, APART_M) for other in taken):
            return pose
    return None


def _proposal(
    box: Corners, at_wall: bool, room_m: tuple[float, float], rng: np.random.Generator
) -> Pose | None:
    """A pose within the walls: a side along a wall and near it, or anywhere; None if it does not fit so."""
    squared = at_wall or rng.random() < 0.4
    yaw = 90.0 * rng.integers(4) + rng.normal(0, 2.0) if squared else rng.uniform(0, 360)
    pose = np.eye(4)
    pose[:3, :3] = np.round(Rotation.from_euler("z", yaw, degrees=True).as_matrix(), DECIMALS)
    turned = _turned(box, pose)
    low, high = -np.array(room_m) / 2 - turned.min(axis=0), np.array(room_m) / 2 - turned.max(axis=0)
    low, high = low + GAP_M[0], high - GAP_M[0]
    if (low > high).any():
        return None
    place = rng.uniform(low, high)
    if at_wall:
        axis, near = int(rng.integers(2)), rng.uniform(0, GAP_M[1] - GAP_M[0])
        place[axis] = low[axis] + near if rng.random() < 0.5 else high[axis] - near
        place[axis] = np.clip(place[axis], low[axis], high[axis])
    pose[:2, 3] = np.round(place, DECIMALS)
    return pose


def overlap(a: Corners, b: Corners, apart_m: float = 0.0) -> bool:
    """Whether two rectangles come nearer than `apart_m` to each other: no side of either parts them."""
    for one in (a, b):
        for side in (one[1] - one[0], one[2] - one[1]):
            normal = np.array([-side[1], side[0]]) / max(1e-12, float(np.hypot(*side)))
            p, q = a @ normal, b @ normal
            if p.max() + apart_m <= q.min() or q.max() + apart_m <= p.min():
                return False
    return True
