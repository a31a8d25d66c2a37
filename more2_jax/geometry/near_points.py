"""Points of a large scan by cells: what lies near a place, or in view, is had without a look at the rest."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from more2_jax.geometry.poses import Points

CELL_M = 1.0  # a side: about as many points in a cell as cells in a room
TOUCHING_M = 1e-6  # apart by rounding
RADIUS_M = CELL_M * np.sqrt(3) / 2  # of the ball that holds a cell
# Makes one number of a cell; a million cells either way along each axis
SIDES = np.array([1 << 42, 1 << 21, 1])


class NearPoints:
    """Points (meters) of which those near places, or in view from them, are asked for."""

    def __init__(self, points: Points) -> None:
        cell = np.floor(points / CELL_M).astype(np.int64)
        order = np.argsort(cell @ SIDES, kind="stable")
        self._given, self._order, self._points = points, order, points[order]
        _, first = np.unique((cell @ SIDES)[order], return_index=True)
        self._ends = np.append(first, len(points))
        self._center = (cell[order[first]] + 0.5) * CELL_M
        self._tree = KDTree(self._center) if len(first) else None

    def cells_around(self, place: Float[np.ndarray, "3"], reach_m: float) -> Int[np.ndarray, " c"]:
        """The cells that may hold points within the reach of a place."""
        if self._tree is None:
            return np.zeros(0, int)
        return np.array(sorted(self._tree.query_ball_point(place, reach_m + RADIUS_M)), int)

    def in_view(
        self,
        cells: Int[np.ndarray, " c"],
        eye: Float[np.ndarray, "3"],
        forward: Float[np.ndarray, "3"],
        half: float,
    ) -> Points:
        """The points of some cells that a sensor may see, and some beside; in no order.

        `half`: the tangent of half the angle of its square image, `forward` the unit direction of its middle.
        """
        offset = self._center[cells] - eye
        depth = offset @ forward
        across = np.sqrt(np.maximum((offset**2).sum(axis=1) - depth**2, 0.0))
        corner = np.sqrt(2) * half
        seen = across <= corner * depth + RADIUS_M * np.sqrt(1 + corner**2)
        return self.points_of(cells[seen | (depth**2 + across**2 <= RADIUS_M**2)])

    def points_of(self, cells: Int[np.ndarray, " c"]) -> Points:
        """All points of some cells."""
        parts = [self._points[self._ends[c] : self._ends[c + 1]] for c in cells.tolist()]
        return np.concatenate(parts) if parts else self._points[:0]

    def around_box(self, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> Points:
        """The points of a box, and some beside it, in the order in which they were given."""
        apart = np.abs(self._center - (low + high) / 2) - (high - low) / 2
        cells = np.flatnonzero((apart <= CELL_M / 2 + TOUCHING_M).all(axis=1))
        parts = [self._order[self._ends[c] : self._ends[c + 1]] for c in cells.tolist()]
        return self._given[np.sort(np.concatenate(parts))] if parts else self._given[:0]
