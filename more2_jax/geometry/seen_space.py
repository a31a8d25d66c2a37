"""What a scan saw, to be asked whether a place is empty; z up.

No sensor places are needed: where a scan has a point well below a place, it looked past that place, so what stands
there would have left points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from more2_jax.geometry.poses import Points

# Chosen on rooms of validation furniture (docs/developing/notebook/matching_evidence.md).
CELL_M = 0.15  # a side of a column: scans hold a point every few centimeters
BELOW_M = 0.05  # a point this far below a place was seen past it
BLOCK = 64  # columns along a side of what is searched at once, 9.6 m: a room or two
BESIDE = 2  # columns beside a block that are searched with it: a place at its border reaches so far
BLOCKS_KEPT = 8  # of a scan, with their search trees; pairs are asked about place by place
Block = tuple[int, int]  # its steps along x and y
SIDES = 1 << 32  # of a grid of columns or blocks: makes one number of two steps


class SeenSpace:
    """All clouds of a scan, meters, by nearness and by columns.

    Clouds are held as they are given, not copied. What lies in a block is put in order when that is first asked about,
    so that the memory of a building is that of a few rooms.
    """

    def __init__(self, clouds: Sequence[Points]) -> None:
        self._clouds = [c for c in clouds if len(c)]
        ends = [column_of(np.stack([c.min(axis=0), c.max(axis=0)])) for c in self._clouds]
        self._ends = np.reshape(ends, (-1, 2, 2)).astype(np.int64)
        self._blocks: dict[Block, SeenBlock] = {}

    def empty(self, places: Float[np.ndarray, "n 3"], reach_m: float) -> Bool[np.ndarray, " n"]:
        """Where the scan has nothing within `reach_m` of a place, and a point below it that it was seen past.

        Raises ValueError for a reach of more than `BESIDE` columns.
        """
        if reach_m > BESIDE * CELL_M:
            raise ValueError(f"empty got a reach of {reach_m} m; needed {BESIDE * CELL_M} at most")
        column, empty = column_of(places), np.zeros(len(places), bool)
        block = numbered(column // BLOCK)
        for b in np.unique(block):
            rows = np.flatnonzero(block == b)
            i, j = (column[rows[0]] // BLOCK).tolist()
            empty[rows] = self._block((i, j)).empty(places[rows], column[rows], reach_m)
        return empty

    def _block(self, at: Block) -> SeenBlock:
        """What lies in a block: kept from an earlier question, or put in order, the oldest of many given up for it."""
        if at not in self._blocks:
            if len(self._blocks) >= BLOCKS_KEPT:
                del self._blocks[next(iter(self._blocks))]
            self._blocks[at] = SeenBlock.of(self._points_about(at))
        return self._blocks[at]

    def _points_about(self, at: Block) -> Points:
        """Everything in a block and beside it."""
        first = np.array(at) * BLOCK - BESIDE
        last = first + BLOCK + 2 * BESIDE - 1
        meets = ((self._ends[:, 0] <= last) & (self._ends[:, 1] >= first)).all(axis=1)
        parts = [np.zeros((0, 3))]
        for k in np.flatnonzero(meets).tolist():
            column = column_of(self._clouds[k])
            parts.append(self._clouds[k][((column >= first) & (column <= last)).all(axis=1)])
        return np.concatenate(parts)


@dataclass(frozen=True, kw_only=True)
class SeenBlock:
    """The points of some columns."""

    tree: KDTree | None
    column: Int[np.ndarray, " c"]  # those with points, as numbers, ascending,
    lowest: Float[np.ndarray, " c"]  # and how low these reach

    @classmethod
    def of(cls, points: Points) -> SeenBlock:
        """From the points in any order."""
        number = numbered(column_of(points))
        if not len(points):
            return cls(tree=None, column=number, lowest=points[:, 2])
        order = np.argsort(number)
        column, first = np.unique(number[order], return_index=True)
        lowest = np.minimum.reduceat(points[order, 2], first)
        # Made in less time than a balanced one; few questions are asked of it.
        return cls(
            tree=KDTree(points, compact_nodes=False, balanced_tree=False), column=column, lowest=lowest
        )

    def empty(
        self, places: Float[np.ndarray, "n 3"], column: Int[np.ndarray, "n 2"], reach_m: float
    ) -> Bool[np.ndarray, " n"]:
        """`SeenSpace.empty` of places in the block."""
        if self.tree is None:
            return np.zeros(len(places), bool)
        number = numbered(column)
        at = np.minimum(np.searchsorted(self.column, number), len(self.column) - 1)
        empty = (self.column[at] == number) & (self.lowest[at] < places[:, 2] - BELOW_M)
        empty[empty] = np.isinf(self.tree.query(places[empty], distance_upper_bound=reach_m)[0])
        return empty


def column_of(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n 2"]:
    """The column that each point lies in, by its steps along x and y."""
    return np.floor(points[:, :2] / CELL_M).astype(np.int64)


def numbered(cells: Int[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
    """A number for every pair of steps."""
    return cells[:, 0] * SIDES + cells[:, 1]
