"""What a room has besides its labeled furniture: floor, walls and clutter, all of simple shapes.

Nobody labels any of it, and all of it occludes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from train.rooms.arrangement import Circle
from train.rooms.ray_scanner import free_spot

CEILING_M = (2.35, 2.7)  # height of the walls, least and most; there is no ceiling: people hardly scan it
WALL_M = 0.1
FLOORS = ((0.55, 0.42, 0.30), (0.62, 0.60, 0.57), (0.40, 0.30, 0.22), (0.70, 0.64, 0.52))
BASEBOARD = (0.95, 0.95, 0.93)
WALLS = ((0.88, 0.87, 0.84), (0.80, 0.84, 0.86), (0.90, 0.85, 0.74))
ON_WALLS, ON_FLOOR = (4, 8), (2, 4)  # pieces of clutter, least and most
SMALLEST_M, LARGEST_M = 0.12, 0.4  # edges of clutter on the floor


@dataclass(frozen=True, kw_only=True)
class Shape:
    """One unlabeled thing in the room's frame, meters, in one color (shares of red, green, blue)."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    color: Float[np.ndarray, " 3"]


def box(low: Sequence[float], high: Sequence[float], color: ArrayLike) -> Shape:
    """An axis-aligned box between two corners."""
    made = trimesh.creation.box(bounds=np.array([low, high]))
    return Shape(vertices=np.asarray(made.vertices), faces=np.asarray(made.faces), color=np.asarray(color))


def shell(room_m: tuple[float, float], rng: np.random.Generator) -> list[Shape]:
    """Floor, four walls, baseboards, a door with its frame, a rug, and things on the walls: no visit changes them."""
    x, y = room_m[0] / 2 + WALL_M, room_m[1] / 2 + WALL_M
    top = float(rng.uniform(*CEILING_M))
    wall, floor = WALLS[rng.integers(len(WALLS))], FLOORS[rng.integers(len(FLOORS))]
    shapes = [box((-x, -y, -WALL_M), (x, y, 0), floor)]
    for side in range(4):
        length = room_m[1 - side % 2]
        shapes.append(box(*_against(room_m, side, 0.0, length + 2 * WALL_M, -WALL_M, (0.0, top)), wall))
        shapes.append(box(*_against(room_m, side, 0.0, length, 0.015, (0.0, 0.09)), BASEBOARD))
    return [*shapes, *_door(room_m, rng), _rug(room_m, rng), *_on_walls(room_m, rng)]


def _against(
    room_m: tuple[float, float], side: int, along: float, width: float, deep: float, z: tuple[float, float]
) -> tuple[list[float], list[float]]:
    """Corners of a box flat on a wall: its middle `along` the wall, standing `deep` into the room."""
    half = room_m[side % 2] / 2
    reach = sorted((half, half - deep)) if side < 2 else sorted((-half, -half + deep))
    low, high = [0.0, 0.0, z[0]], [0.0, 0.0, z[1]]
    low[side % 2], high[side % 2] = reach
    low[1 - side % 2], high[1 - side % 2] = along - width / 2, along + width / 2
    return low, high


def _door(room_m: tuple[float, float], rng: np.random.Generator) -> list[Shape]:
    """A closed door with its frame on one wall."""
    side = int(rng.integers(4))
    reach = room_m[1 - side % 2] / 2 - 0.6
    along, frame, leaf = float(rng.uniform(-reach, reach)), (0.93, 0.92, 0.9), rng.uniform(0.3, 0.8, 3)
    shapes = [box(*_against(room_m, side, along, 0.86, 0.02, (0.0, 2.02)), leaf)]
    for shift in (-0.47, 0.47):
        shapes.append(box(*_against(room_m, side, along + shift, 0.08, 0.05, (0.0, 2.1)), frame))
    return [*shapes, box(*_against(room_m, side, along, 0.86, 0.05, (2.02, 2.1)), frame)]


def _rug(room_m: tuple[float, float], rng: np.random.Generator) -> Shape:
    size = rng.uniform(0.25, 0.5, 2) * room_m
    middle = rng.uniform(-0.2, 0.2, 2) * room_m
    low, high = middle - size / 2, middle + size / 2
    return box((*low, -0.01), (*high, 0.006), rng.uniform(0.2, 0.8, 3))


def _on_walls(room_m: tuple[float, float], rng: np.random.Generator) -> list[Shape]:
    """Pictures, radiators, boards: nothing that reaches far into the room."""
    shapes = []
    for _ in range(int(rng.integers(ON_WALLS[0], ON_WALLS[1] + 1))):
        side, width = int(rng.integers(4)), float(rng.uniform(0.3, 1.1))
        reach = room_m[1 - side % 2] / 2 - width / 2
        along, low = float(rng.uniform(-reach, reach)), float(rng.choice([0.15, 1.2, 1.4]))
        deep, high = float(rng.uniform(0.02, 0.08)), low + float(rng.uniform(0.3, 0.7))
        shapes.append(
            box(*_against(room_m, side, along, width, deep, (low, high)), rng.uniform(0.1, 0.95, 3))
        )
    return shapes


def loose_clutter(
    room_m: tuple[float, float], taken: Sequence[Circle], rng: np.random.Generator
) -> list[Shape]:
    """Boxes and round things on the floor, clear of what is `taken`: other ones at every visit."""
    shapes, occupied = [], list(taken)
    for _ in range(int(rng.integers(ON_FLOOR[0], ON_FLOOR[1] + 1))):
        size, turn = rng.uniform(SMALLEST_M, LARGEST_M, 3), float(rng.uniform(0, np.pi))
        color, is_round = rng.uniform(0.1, 0.9, 3), rng.random() < 0.4
        radius = float(size[0] / 2 if is_round else np.hypot(*size[:2]) / 2)
        try:
            x, y = free_spot(rng, radius, occupied, room_m)
        except ValueError:
            continue
        occupied.append((x, y, radius))
        made = trimesh.creation.cylinder(size[0] / 2, size[2], 16) if is_round else trimesh.creation.box(size)
        made.apply_transform(trimesh.transformations.rotation_matrix(turn, [0, 0, 1]))
        vertices = np.asarray(made.vertices) + [x, y, size[2] / 2]
        shapes.append(Shape(vertices=vertices, faces=np.asarray(made.faces), color=color))
    return shapes
