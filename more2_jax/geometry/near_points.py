"""Points of a large scan by cells: what lies near a place is had without a look at all the rest."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float, Int

from more2_jax.geometry.poses import Points

CELLS = 3  # of a reach
SIDES = np.array(
    [1 << 42, 1 << 21, 1]
)  # makes one number of a cell; a million cells either way along each axis
WAYS = np.array(list(itertools.product(range(-CELLS, CELLS + 1), repeat=3)))


class NearPoints:
    """Points (meters) of which those within `reach_m` of places are asked for."""

    def __init__(self, points: Points, reach_m: float) -> None:
        self.reach_m = reach_m
        key = self._cell(points) @ SIDES
        order = np.argsort(key, kind="stable")
        self._points = points[order]
        cells, first, count = np.unique(key[order], return_index=True, return_counts=True)
        ends = zip(cells.tolist(), first.tolist(), (first + count).tolist(), strict=True)
        self._rows = {cell: slice(a, b) for cell, a, b in ends}

    def around(self, place: Float[np.ndarray, "3"]) -> Points:
        """All points within the reach of a place, and some a little farther off, in no order."""
        held = [self._rows.get(cell) for cell in ((self._cell(place) + WAYS) @ SIDES).tolist()]
        parts = [self._points[rows] for rows in held if rows is not None]
        return np.concatenate(parts) if parts else self._points[:0]

    def _cell(self, points: Float[np.ndarray, "*n 3"]) -> Int[np.ndarray, "*n 3"]:
        return np.floor(points * (CELLS / self.reach_m)).astype(np.int64)
