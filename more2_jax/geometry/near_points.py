"""Points of a large scan by cells: what lies near a place, or in view, is had without a look at the rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from more2_jax.geometry.poses import Points

CELL_M = 1.0  # a side: about as many points in a cell as cells in a room
TOUCHING_M = 1e-6  # apart by rounding
RADIUS_M = CELL_M * np.sqrt(3) / 2  # of the ball that holds a cell
# Makes one number of a cell; a million cells either way along each axis
SIDES = np.array([1 << 42, 1 << 21, 1])

Made = Callable[[], Points]  # makes a cloud when it is needed


class NearPoints:
    """Points (meters) of which those near places, or in view from them, are asked for."""

    def __init__(self, points: Points) -> None:
        number = np.zeros(len(points), np.int64)
        for side, x in zip(SIDES, points.T, strict=True):  # one axis at a time: large scans
            number += side * np.floor(x / CELL_M).astype(np.int64)
        order = np.argsort(number, kind="stable")
        number = number[order]
        first = np.flatnonzero(np.append(True, number[1:] != number[:-1])[: len(points)])
        del number  # of a building 130 MB, while its points are held twice
        order = order.astype(np.int32)
        self._order, self._points = order, points[order]  # all that is kept of a large scan
        self._ends = np.append(first, len(points))
        self._center = (np.floor(self._points[first] / CELL_M) + 0.5) * CELL_M
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
        cells = self.cells_of_box(low, high)
        given = [self._order[self._ends[c] : self._ends[c + 1]] for c in cells]
        return (
            self.points_of(np.array(cells))[np.argsort(np.concatenate(given))] if given else self._points[:0]
        )

    def rows_around_box(
        self, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]
    ) -> Int[np.ndarray, " m"]:
        """The rows of those points among the given ones, ascending."""
        given = [self._order[self._ends[c] : self._ends[c + 1]] for c in self.cells_of_box(low, high)]
        return np.sort(np.concatenate(given)) if given else self._order[:0]

    def cells_of_box(self, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> list[int]:
        """The cells that may hold points of a box."""
        apart = np.abs(self._center - (low + high) / 2) - (high - low) / 2
        return np.flatnonzero((apart <= CELL_M / 2 + TOUCHING_M).all(axis=1)).tolist()


class NearClouds:
    """Clouds of a large scan, of which those near some places are put in order together.

    What was put in order last is kept: for places in a single room it is always the same.
    """

    def __init__(self, clouds: Sequence[Made], rest: Points) -> None:
        """`rest`: points of no cloud, such as the background."""
        balls = [ball_around(cloud()) for cloud in clouds]
        self._clouds, self.rest = clouds, NearPoints(rest)
        self._center = np.reshape([center for center, _ in balls], (-1, 3))
        self._radius = np.array([radius for _, radius in balls])
        self._last: tuple[tuple[list[int], list[int]], NearPoints] | None = None

    def near(self, places: Sequence[Float[np.ndarray, "3"]], reach_m: float) -> NearPoints:
        """All points in the cells within the reach of a place (`NearPoints.cells_around`), and some beside."""
        reach = reach_m + 2 * RADIUS_M + TOUCHING_M
        near = np.zeros(len(self._clouds), bool)
        for place in places:
            near |= np.linalg.norm(self._center - place, axis=1) <= reach + self._radius
        low, high = (np.reshape(f(places, axis=0), 3) if places else np.zeros(3) for f in (np.min, np.max))
        key = np.flatnonzero(near).tolist(), self.rest.cells_of_box(low - reach, high + reach)
        if self._last is None or self._last[0] != key:
            self._last = None  # let go before the next one is made
            rest = self.rest.around_box(low - reach, high + reach)
            self._last = key, NearPoints(np.concatenate([*(self._clouds[k]() for k in key[0]), rest]))
        return self._last[1]


def ball_around(points: Points) -> tuple[Float[np.ndarray, "3"], float]:
    """The center and radius of a ball that holds the points; of none, one that nothing reaches."""
    if not len(points):
        return np.zeros(3), -np.inf
    center = (points.min(axis=0) + points.max(axis=0)) / 2
    return center, float(np.linalg.norm(points - center, axis=1).max())


def rms_radius(points: Points) -> float:
    """Root of the mean squared distance from the mean, meters: how large a cloud is, whatever lies far from it."""
    return float(np.sqrt(points.var(axis=0).sum()))
