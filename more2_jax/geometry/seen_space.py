"""What a scan saw, to be asked whether a place is empty; z up.

No sensor places are needed: where a scan has a point well below a place, it looked past that place, so what stands
there would have left points.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from more2_jax.geometry.poses import Points

# Chosen on rooms of validation furniture (docs/developing/notebook/matching_evidence.md).
CELL_M = 0.15  # a side of a column: scans hold a point every few centimeters
BELOW_M = 0.05  # a point this far below a place was seen past it
COLUMNS = 1 << 21  # a side of the grid of columns: 300 km


class SeenSpace:
    """All points of a scan, meters, by nearness and by columns."""

    def __init__(self, points: Points) -> None:
        self._tree = KDTree(points) if len(points) else None
        key = column_of(points)
        order = np.lexsort((points[:, 2], key))
        self._column, first = np.unique(key[order], return_index=True)
        self._lowest = points[order, 2][first]

    def empty(self, places: Float[np.ndarray, "n 3"], reach_m: float) -> Bool[np.ndarray, " n"]:
        """Where the scan has nothing within `reach_m` of a place, and a point below it that it was seen past."""
        if self._tree is None:
            return np.zeros(len(places), bool)
        nearest, _ = self._tree.query(places, distance_upper_bound=reach_m)
        key = column_of(places)
        at = np.minimum(np.searchsorted(self._column, key), len(self._column) - 1)
        below = (self._column[at] == key) & (self._lowest[at] < places[:, 2] - BELOW_M)
        return np.isinf(nearest) & below


def column_of(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """A number for the column that each point lies in."""
    cell = np.floor(points[:, :2] / CELL_M).astype(np.int64) + COLUMNS // 2
    return cell[:, 0] * COLUMNS + cell[:, 1]
