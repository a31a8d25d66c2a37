"""Small things that stand on furniture, at most visits on another piece than before: in homes, much of what moves.

`furnish` places what stands on the floor. What is small comes after it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from train.rooms.arrangement import DECIMALS
from train.rooms.furnishing import MOVED_M, furnish
from train.rooms.ray_scanner import Pose, footprint_radius, free_spot

SMALL_M = 0.65  # longest edge of what may stand on furniture
ON_FURNITURE = 0.8  # share of the small things that do; the others stand on the floor
SURFACES_M = (0.25, 1.25)  # heights that things are put at
UNEVEN_M = 0.02  # of a surface that something stands on
RIM = 0.8  # share of a footprint that the surface has to bear
APART_M = 0.05  # between two things on one piece
TRIES = 40


@dataclass(frozen=True, kw_only=True)
class Bearer:
    """A piece that things may stand on, as it stands."""

    name: str
    mesh: trimesh.Trimesh
    pose: Pose


@dataclass(frozen=True, kw_only=True)
class Arranged:
    """Where everything stands at one visit, and what bears each small thing (none: the floor)."""

    poses: dict[str, Pose]
    borne_by: dict[str, str]


def is_small(vertices: Float[np.ndarray, "v 3"]) -> bool:
    """Whether something may stand on furniture."""
    return bool(np.ptp(vertices, axis=0).max() <= SMALL_M)


def furnish_and_lay(
    present: Mapping[str, tuple[np.ndarray, np.ndarray]],
    before: Arranged,
    static: Collection[str],
    room_m: tuple[float, float],
    rng: np.random.Generator,
) -> Arranged:
    """A pose in the room for everything present (vertices and faces): what is small stands on what is not, mostly.

    Static small things stay on what bears them, wherever that goes. Raises ValueError when the room is too full.
    """
    large = {n: v for n, (v, _) in present.items() if not is_small(v)}
    stay = [n for n in static if n in large]
    poses = furnish(large, before.poses, stay, room_m, rng)
    bearers = [_bearer(n, *present[n], poses[n]) for n in large]
    taken = [(*poses[n][:2, 3], footprint_radius(v)) for n, v in large.items()]
    borne_by: dict[str, str] = {}
    on_top: dict[str, list[tuple[float, float, float]]] = {n: [] for n in large}
    for n in (n for n in present if n not in large):
        vertices, last = present[n][0], before.poses.get(n)
        bearer = before.borne_by.get(n)
        if n in static and last is not None and (bearer is None or bearer in poses):
            T = np.eye(4) if bearer is None else poses[bearer] @ np.linalg.inv(before.poses[bearer])
            pose, found = np.round(T @ last, DECIMALS), bearer
        else:
            pose, found = _new_place(vertices, bearers, on_top, taken, last, room_m, rng)
        poses[n] = pose
        circle = (*pose[:2, 3], footprint_radius(vertices))
        (taken if found is None else on_top[found]).append(circle)
        if found is not None:
            borne_by[n] = found
    return Arranged(poses={n: poses[n] for n in present}, borne_by=borne_by)


def _bearer(name: str, vertices: np.ndarray, faces: np.ndarray, pose: Pose) -> Bearer:
    placed = vertices @ pose[:3, :3].T + pose[:3, 3]
    return Bearer(name=name, mesh=trimesh.Trimesh(placed, faces, process=False), pose=pose)


def _new_place(
    vertices: np.ndarray,
    bearers: Collection[Bearer],
    on_top: Mapping[str, list[tuple[float, float, float]]],
    on_floor: list[tuple[float, float, float]],
    last: Pose | None,
    room_m: tuple[float, float],
    rng: np.random.Generator,
) -> tuple[Pose, str | None]:
    """On some piece, or on the floor, and which; elsewhere than `last`. Raises ValueError if there is no place."""
    tries = TRIES if rng.random() < ON_FURNITURE else 0
    names = list(bearers)
    for _ in range(tries):
        bearer = names[int(rng.integers(len(names)))]
        pose = _laid(vertices, bearer, on_top[bearer.name], rng)
        if pose is not None and (last is None or np.linalg.norm((pose - last)[:3, 3]) >= MOVED_M):
            return pose, bearer.name
    for _ in range(TRIES):
        pose = _turned(rng)
        pose[:2, 3] = np.round(free_spot(rng, footprint_radius(vertices), on_floor, room_m), DECIMALS)
        if last is None or np.linalg.norm((pose - last)[:3, 3]) >= MOVED_M:
            return pose, None
    raise ValueError("no place for a small thing; needed more room")


def _turned(rng: np.random.Generator) -> Pose:
    """Standing at the origin, turned at random."""
    pose = np.eye(4)
    yaw = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi))
    pose[:3, :3] = np.round(yaw.as_matrix(), DECIMALS)
    return pose


def _laid(
    vertices: np.ndarray,
    bearer: Bearer,
    others: Collection[tuple[float, float, float]],
    rng: np.random.Generator,
) -> Pose | None:
    """A pose on top of a piece; None where it is uneven, too high or low, or taken."""
    pose, radius = _turned(rng), footprint_radius(vertices)
    low, high = bearer.mesh.bounds
    x, y = rng.uniform(low[:2], high[:2])
    if any(np.hypot(x - a, y - b) < radius + r + APART_M for a, b, r in others):
        return None
    (x0, y0), (x1, y1) = RIM * vertices[:, :2].min(axis=0), RIM * vertices[:, :2].max(axis=0)
    grid = np.stack(np.meshgrid([x0, (x0 + x1) / 2, x1], [y0, (y0 + y1) / 2, y1]), axis=-1).reshape(-1, 2)
    feet = np.column_stack([grid @ pose[:2, :2].T + [x, y], np.full(len(grid), high[2] + 0.1)])
    down = np.tile([0.0, 0.0, -1.0], (len(feet), 1))
    hits, ray, _ = bearer.mesh.ray.intersects_location(feet, down, multiple_hits=False)
    if len(set(ray)) < len(feet) or np.ptp(hits[:, 2]) > UNEVEN_M:
        return None
    z = float(hits[:, 2].max())
    if not SURFACES_M[0] <= z <= SURFACES_M[1]:
        return None
    pose[:3, 3] = np.round([x, y, z], DECIMALS)
    return pose
