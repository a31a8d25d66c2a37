"""Points of a large scan by cells: what lies near a place is had without a look at all the rest."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float

from more2_jax.geometry.poses import Points

CELLS = 3  # of a reach


class NearPoints:
    """Points (meters) of which those within `reach_m` of places are asked for."""

    def __init__(self, points: Points, reach_m: float) -> None:
        self.reach_m = reach_m
        cell = self._cell(points)
        order = np.lexsort(cell.T)
        self._points, cell = points[order], cell[order]
        cells, first, count = np.unique(cell, axis=0, return_index=True, return_counts=True)
        self._rows = {
            tuple(c): slice(a, a + n)
            for c, a, n in zip(cells.tolist(), first.tolist(), count.tolist(), strict=True)
        }

    def around(self, place: Float[np.ndarray, "3"]) -> Points:
        """All points within the reach of a place, and some a little farther off, in no order."""
        ways = itertools.product(range(-CELLS, CELLS + 1), repeat=3)
        middle = self._cell(place)
        held = [self._rows.get(tuple((middle + way).tolist())) for way in ways]
        parts = [self._points[rows] for rows in held if rows is not None]
        return np.concatenate(parts) if parts else self._points[:0]

    def _cell(self, points: Float[np.ndarray, "*n 3"]) -> np.ndarray:
        return np.floor(points * (CELLS / self.reach_m)).astype(np.int64)
