"""A rectangular room, empty or with boxes that no turn of it puts onto one another."""

from __future__ import annotations

import numpy as np

NOISE_M = 0.003
PER_M2 = 500
BOXES = [
    ([0.9, 2.7, 0.5], [1.0, 0.8, 1.0]),
    ([3.9, 0.7, 0.3], [0.7, 0.5, 0.6]),
    ([2.4, 3.2, 0.4], [1.2, 0.5, 0.8]),
]


def panel(rng: np.random.Generator, low, high) -> np.ndarray:
    """Points on a flat box."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    count = int(PER_M2 * np.prod(np.sort(high - low)[1:]))
    return rng.uniform(low, high, (count, 3)) + rng.normal(0, NOISE_M, (count, 3))


def box(rng: np.random.Generator, middle, size) -> np.ndarray:
    """All sides of a box but its bottom."""
    low, high = np.asarray(middle) - np.asarray(size) / 2, np.asarray(middle) + np.asarray(size) / 2
    sides = []
    for axis, end in ((0, low), (0, high), (1, low), (1, high), (2, high)):
        a, b = low.copy(), high.copy()
        a[axis] = b[axis] = end[axis]
        sides.append(panel(rng, a, b))
    return np.concatenate(sides)


def empty_room(sides_m: tuple[float, float], seed: int) -> np.ndarray:
    """Points of the floor and of four walls, 2 m high; a corner in the origin."""
    x, y = sides_m
    rng = np.random.default_rng(seed)
    walls = [([0, 0, 0], [0, y, 2]), ([x, 0, 0], [x, y, 2]), ([0, 0, 0], [x, 0, 2]), ([0, y, 0], [x, y, 2])]
    return np.concatenate([panel(rng, *p) for p in ([[0, 0, 0], [x, y, 0]], *walls)])


def furnished_room(sides_m: tuple[float, float], seed: int) -> np.ndarray:
    """The same with `BOXES`."""
    rng = np.random.default_rng(seed + 1000)
    return np.concatenate([empty_room(sides_m, seed), *(box(rng, *b) for b in BOXES)])
