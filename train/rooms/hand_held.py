"""The path of a depth camera in a hand: at walking height through the room, looking at one thing after the other.

The pose that a scanner believes drifts from the true one: a random walk of millimeters and tenths of a degree a
frame, pulled back as loop closure does, which makes walls thick.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from train.rooms.arrangement import Circle
from train.rooms.depth_sensor import DepthSensor
from train.rooms.ray_scanner import camera_matrix, looking

LOWEST_M, HIGHEST_M = 1.15, 1.65  # of the camera
DISTANCE_M = (1.0, 2.4)  # from what it looks at
CLEARANCE_M = 0.25  # from walls, and from circles about objects
TRIES = 60
# An incomplete scan never looks at a part of the room: the middle of some object lies so far inside, and whatever lies
# deeper than its edge is out of sight, which is held at these heights over a grid.
INSIDE_M, EDGE_M, HEIGHTS_M, GRID = (0.4, 0.8), 0.15, (0.05, 0.6), 25
FEWEST_FRAMES = 30
AHEAD = 0.4  # of the step from the camera to what it looks at, at most, leads toward that part


@dataclass(frozen=True)
class Walk:
    """How long a person takes, and how well the device knows where it is."""

    views_of_an_object: int = 3  # directions that each object is looked at from, at most
    views_of_walls: int = 12  # other places looked at, around the room
    frames_a_view: int = 6  # from one view to the next; twice as many where some are then dropped
    most_frames: int = 300
    step_m: float = 0.004  # drift a frame, standard deviation along each axis
    step_deg: float = 0.12
    pull: float = 0.06  # share of the drift that is taken back at every frame


@dataclass(frozen=True, kw_only=True)
class Blind:
    """The part of the room that a scan skips: where `normal · (x, y) > offset_m`."""

    normal: Float[np.ndarray, " 2"]
    offset_m: float
    places: Float[np.ndarray, "p 3"]  # all over it, less its edge

    def hides(self, places: Float[np.ndarray, "n 2"]) -> np.ndarray:
        """Which places lie in it."""
        return places @ self.normal > self.offset_m


def blind_part(
    targets: Sequence[Float[np.ndarray, " 3"]], room_m: tuple[float, float], rng: np.random.Generator
) -> Blind:
    """A part of the room beyond a random line that has at least one of the targets well inside."""
    angle = rng.uniform(0, 2 * np.pi)
    normal = np.array([np.cos(angle), np.sin(angle)])
    farthest = max(float(t[:2] @ normal) for t in targets)
    grid = np.stack(np.meshgrid(*(np.linspace(-s / 2, s / 2, GRID) for s in room_m)), axis=-1).reshape(-1, 2)
    offset = farthest - rng.uniform(*INSIDE_M)
    deep = grid[grid @ normal > offset + EDGE_M]
    places = np.concatenate([np.column_stack([deep, np.full(len(deep), z)]) for z in HEIGHTS_M])
    return Blind(normal=normal, offset_m=offset, places=places)


def walk(
    targets: Sequence[Float[np.ndarray, " 3"]],
    taken: Sequence[Circle],
    room_m: tuple[float, float],
    config: Walk,
    blind: Blind | None,
    rng: np.random.Generator,
) -> Float[np.ndarray, "frames 4 4"]:
    """T_room_camera of every frame; `targets` (room frame, meters) are objects' middles, `taken` where not to stand.

    Raises ValueError if there is nowhere to stand.
    """
    stops = _stops(targets, taken, room_m, config, blind, rng)
    each = config.frames_a_view if blind is None else 2 * config.frames_a_view
    frames = min(config.most_frames, each * (len(stops) - 1) + 1)
    at = np.linspace(0, len(stops) - 1, frames)
    first = np.minimum(at.astype(int), len(stops) - 2)
    share = at - first
    smooth = (share * share * (3 - 2 * share))[:, None]
    eyes, seen = (np.stack(part) for part in zip(*stops, strict=True))
    eye = eyes[first] * (1 - share[:, None]) + eyes[first + 1] * share[:, None]
    eye = _clear(eye + [0, 0, 1] * rng.normal(0, 0.02, (frames, 1)), taken, room_m)
    target = seen[first] * (1 - smooth) + seen[first + 1] * smooth
    poses = np.stack([camera_matrix(looking(e, t)) for e, t in zip(eye, target, strict=True)])
    roll = Rotation.from_rotvec([0, 0, 4] * rng.normal(size=(frames, 1)), degrees=True).as_matrix()
    poses[:, :3, :3] = poses[:, :3, :3] @ roll
    return np.round(poses, 9)


def _stops(
    targets: Sequence[np.ndarray],
    taken: Sequence[Circle],
    room_m: tuple[float, float],
    config: Walk,
    blind: Blind | None,
    rng: np.random.Generator,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Where the camera stands and what it looks at, in the order of a walk around the room."""
    wanted = [t for t in targets for _ in range(int(rng.integers(1, config.views_of_an_object + 1)))]
    for _ in range(config.views_of_walls):
        angle, z = rng.uniform(0, 2 * np.pi), rng.uniform(0.1, 1.8)
        wanted.append(np.array([*(0.5 * np.array(room_m) * (np.cos(angle), np.sin(angle))), z]))
    if blind is not None:
        wanted = [t for t in wanted if not blind.hides(t[None, :2])[0]]
    places = [(_standing(t, taken, room_m, blind, rng), t) for t in wanted]
    stops = [(eye, t) for eye, t in places if eye is not None]
    start = rng.uniform(-np.pi, np.pi)
    around = [(np.arctan2(eye[1], eye[0]) - start) % (2 * np.pi) for eye, _ in stops]
    ordered = [stops[k] for k in np.argsort(around)]
    if len(ordered) < 2:
        raise ValueError(
            f"nowhere to stand for a camera in a room of {room_m[0]:.1f} × {room_m[1]:.1f} m; needed more room"
        )
    return ordered


def _standing(
    target: np.ndarray,
    taken: Sequence[Circle],
    room_m: tuple[float, float],
    blind: Blind | None,
    rng: np.random.Generator,
) -> np.ndarray | None:
    """A free place to look at a target from, not toward the skipped part; None if none is found."""
    half = np.array(room_m) / 2 - CLEARANCE_M
    for k in range(TRIES):
        angle, distance = rng.uniform(0, 2 * np.pi), rng.uniform(*DISTANCE_M) * (1 + k / TRIES)
        step = distance * np.array([np.cos(angle), np.sin(angle)])
        place = target[:2] - step
        inside = (np.abs(place) < half).all()
        if blind is not None:
            inside &= not blind.hides(place[None])[0] and step @ blind.normal < AHEAD * distance
        if inside and all(np.hypot(place[0] - x, place[1] - y) > r for x, y, r in taken):
            return np.array([*place, rng.uniform(LOWEST_M, HIGHEST_M)])
    return None


def _clear(
    eye: Float[np.ndarray, "f 3"], taken: Sequence[Circle], room_m: tuple[float, float]
) -> Float[np.ndarray, "f 3"]:
    """The path led around what is `taken`, within the walls."""
    eye = eye.copy()
    for x, y, r in taken:
        away = eye[:, :2] - [x, y]
        distance = np.linalg.norm(away, axis=1, keepdims=True)
        inside = distance[:, 0] < r
        eye[inside, :2] = [x, y] + (r * away / np.maximum(distance, 1e-3))[inside]
    half = np.array(room_m) / 2 - CLEARANCE_M
    eye[:, :2] = np.clip(eye[:, :2], -half, half)
    return eye


def turned_away(
    poses: Float[np.ndarray, "f 4 4"], blind: Blind, sensor: DepthSensor
) -> Float[np.ndarray, "f 4 4"]:
    """The frames that have nothing of the skipped part, less its edge, in their field; all if there are none."""
    kept = []
    for T in poses:
        local = (blind.places - T[:3, 3]) @ T[:3, :3]
        kept.append(not (sensor.pixel(local)[1] & (local[:, 2] < sensor.farthest_m)).any())
    return poses[np.array(kept)] if sum(kept) >= FEWEST_FRAMES else poses


def drifted(
    T_room_camera: Float[np.ndarray, "f 4 4"], config: Walk, rng: np.random.Generator
) -> Float[np.ndarray, "f 4 4"]:
    """Where the device believes to be: the true poses, each with the drift of its frame, about the camera."""
    count = len(T_room_camera)
    steps = rng.normal(size=(count, 6)) * ([config.step_m] * 3 + [config.step_deg] * 3)
    drift = np.zeros((count, 6))
    for k in range(1, count):
        drift[k] = (1 - config.pull) * drift[k - 1] + steps[k]
    believed = T_room_camera.copy()
    believed[:, :3, 3] += drift[:, :3]
    turn = Rotation.from_rotvec(drift[:, 3:], degrees=True).as_matrix()
    believed[:, :3, :3] = turn @ believed[:, :3, :3]
    return np.round(believed, 9)
