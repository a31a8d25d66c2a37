"""Which of a scan's axes is up, where nobody said: by a floor at one end, or by the shortest side."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

SLABS = 64  # the scan is cut into this many along each axis to look for its floor
# The turn that makes an axis z, by a quarter or a half about x or y. Phones and renderers export y up.
R_UP = {
    "x": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
    "-x": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
    "-y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "-z": np.diag([1.0, -1.0, -1.0]),
}
FLOOR_SHARE = 0.12  # of all points in one end slab makes it a floor; an even spread gives 1/64


def likely_up_axis(points: Float[np.ndarray, "n 3"]) -> tuple[str | None, str]:
    """The axis away from the floor, and why: a floor is an end slab of the scan that is dense and wide.

    Without a floor, the shortest side of the scan is taken for its height, provided the scan is clearly
    flatter along it (rooms are); up is then where fewer points lie. None where that says nothing either.
    """
    low, size = points.min(axis=0), np.ptp(points, axis=0)
    if (size <= 0).all():
        return None, "all points coincide"
    slab = np.clip((points - low) / np.where(size > 0, size, 1.0) * SLABS, 0, SLABS - 1).astype(int)
    ends = {("+", a): slab[:, a] == 0 for a in range(3)} | {
        ("-", a): slab[:, a] == SLABS - 1 for a in range(3)
    }
    scores = {end: _floor_score(points[rows], end[1], size, len(points)) for end, rows in ends.items()}
    (sign, axis), best = max(scores.items(), key=lambda item: item[1])
    if best > FLOOR_SHARE:
        return f"{sign}{'xyz'[axis]}", f"a wide plane holds {100 * best:.0f} % of the points at the other end"
    return _flattest(points, low, size)


def _floor_score(slab: Float[np.ndarray, "m 3"], axis: int, size: np.ndarray, total: int) -> float:
    """Share of all points in the slab, times how much of the scan's cross-section the slab spans."""
    if not len(slab):
        return 0.0
    across = [a for a in range(3) if a != axis]
    span = np.ptp(slab, axis=0)[across] / np.where(size[across] > 0, size[across], 1.0)
    return float(len(slab) / total * span.prod())


def _flattest(points: np.ndarray, low: np.ndarray, size: np.ndarray) -> tuple[str | None, str]:
    shortest, next_shortest = np.sort(size)[:2]
    if shortest > 0.7 * next_shortest:
        return None, "no floor, and no axis along which the scan is clearly flatter"
    axis = int(np.argmin(size))
    heavy_below = np.median(points[:, axis]) <= low[axis] + size[axis] / 2
    return (
        f"{'+' if heavy_below else '-'}{'xyz'[axis]}",
        "no floor seen; the scan is flattest along this axis",
    )
