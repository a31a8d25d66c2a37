"""A chair and a table in a corner of a room, as points: what a scan and its masks hold."""

from __future__ import annotations

import numpy as np

SPACING_M = 0.025
NOISE_M = 0.002


def sheet(origin, along, across, rng) -> np.ndarray:
    """Points of a parallelogram, at about `SPACING_M`."""
    origin, along, across = (np.asarray(v, float) for v in (origin, along, across))
    n, m = (max(2, round(np.linalg.norm(v) / SPACING_M)) for v in (along, across))
    u, v = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(m) + 0.5) / m)
    points = origin + u.reshape(-1, 1) * along + v.reshape(-1, 1) * across
    return points + rng.normal(0, NOISE_M, points.shape)


def box(low, high, rng, sides: str = "xXyYZ") -> np.ndarray:
    """Sides of a box: a letter each, upper case for the far one."""
    low, size = np.asarray(low, float), np.subtract(high, low)
    parts = []
    for axis, name in enumerate("xyz"):
        others = [np.eye(3)[k] * size[k] for k in range(3) if k != axis]
        for letter, shift in ((name, 0.0), (name.upper(), size[axis])):
            if letter in sides:
                parts.append(sheet(low + np.eye(3)[axis] * shift, *others, rng))
    return np.concatenate(parts)


def corner(seed: int = 0) -> np.ndarray:
    """Floor and two walls, 3 m by 3 m by 2 m."""
    rng = np.random.default_rng(seed)
    x, y, z = np.diag([3.0, 3.0, 2.0])
    return np.concatenate(
        [sheet([0, 0, 0], x, y, rng), sheet([0, 0, 0], x, z, rng), sheet([0, 0, 0], y, z, rng)]
    )


def chair(seed: int = 1) -> np.ndarray:
    """Four legs of 6 cm, a seat, a back, at (1.2, 1.2) to (1.7, 1.7); it stands on the floor."""
    rng = np.random.default_rng(seed)
    legs = [
        box([x, y, 0.0], [x + 0.06, y + 0.06, 0.42], rng, "xXyY") for x in (1.2, 1.64) for y in (1.2, 1.64)
    ]
    seat = box([1.2, 1.2, 0.42], [1.7, 1.7, 0.48], rng, "xXyYzZ")
    back = box([1.2, 1.2, 0.48], [1.24, 1.7, 1.0], rng, "xXyYZ")
    return np.concatenate([*legs, seat, back])


def cabinet(seed: int = 2) -> np.ndarray:
    """A cabinet at (2.0, 1.1) to (2.6, 1.7), 0.9 m high, closed but for its bottom."""
    return box([2.0, 1.1, 0.0], [2.6, 1.7, 0.9], np.random.default_rng(seed), "xXyYZ")


def beside(points: np.ndarray, cloud: np.ndarray, reach_m: float) -> np.ndarray:
    """Which points lie within a distance of a cloud's footprint."""
    low, high = cloud[:, :2].min(axis=0) - reach_m, cloud[:, :2].max(axis=0) + reach_m
    return ((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)
