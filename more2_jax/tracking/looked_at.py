"""Whether a scan looked at the place of an object: "removed" is said only of what was looked for.

A scan that saw a place has points there: of the object, of what stands there instead, or of the floor under it. Beyond
the paper, which takes every scan to be complete.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from more2_jax.geometry.poses import Points, apply_pose
from more2_jax.tracking.objects import accumulated_points, place_of
from more2_jax.types import Scan, SceneObject

CELL_M = 0.15  # a side of a column of the place: scans hold a point every few centimeters
ABOVE_M = 0.1  # over an object's top: points higher than that tell nothing of its place
LOOKED_AT = 0.35  # share of the place that a scan must have looked at to miss the object
LEAST_BACKGROUND = 200  # points: a scan of objects alone does not tell where it looked


def not_looked_at(
    objects: Sequence[SceneObject],
    missing: Sequence[int],
    scan: Scan,
    T_scene_scan: Float[np.ndarray, "4 4"],
    upright: bool,
) -> tuple[str, ...]:
    """Ids of those `missing` objects whose last place the scan did not look at; none where it has no background."""
    if len(scan.background) < LEAST_BACKGROUND:
        return ()
    if not len(missing):
        return ()
    clouds = (scan.background, *(i.points for i in scan.instances))
    there = (apply_pose(T_scene_scan, points) for points in clouds)
    share = (
        partial(looked_at_upright, room=Columns(there))
        if upright
        else partial(looked_at, room=KDTree(np.concatenate(list(there))))
    )
    return tuple(objects[k].id for k in missing if share(last_place(objects[k])) < LOOKED_AT)


def last_place(o: SceneObject) -> Points:
    """The object's points where it was seen last, in the scene's frame."""
    return apply_pose(place_of(o.observations[-1]), accumulated_points(o))


def looked_at_upright(place: Points, room: Columns) -> float:
    """Share of the columns under a place (z up) that hold points of the scan, not all of them over its top."""
    lowest = room.lowest_m(place)
    return float((lowest < place[:, 2].max() + ABOVE_M).mean())


class Columns:
    """The lowest point of a scan in every column, z up. Its clouds are looked at one by one."""

    def __init__(self, clouds: Iterable[Points]) -> None:
        self._lowest: dict[tuple[int, ...], float] = {}
        for points in (c for c in clouds if len(c)):
            cell = _columns(points)
            order = np.lexsort((points[:, 2], cell[:, 1], cell[:, 0]))
            first = order[np.r_[True, (np.diff(cell[order], axis=0) != 0).any(axis=1)]]
            for column, z in zip(map(tuple, cell[first].tolist()), points[first, 2].tolist(), strict=True):
                self._lowest[column] = min(z, self._lowest.get(column, np.inf))

    def lowest_m(self, place: Points) -> Float[np.ndarray, " c"]:
        """Of every column that holds a point of a place, the height of the scan's lowest; infinite without any."""
        wanted = np.unique(_columns(place), axis=0).tolist()
        return np.array([self._lowest.get(tuple(c), np.inf) for c in wanted])


def _columns(points: Points) -> Int[np.ndarray, "n 2"]:
    return np.floor(points[:, :2] / CELL_M).astype(np.int64)


def looked_at(place: Points, room: KDTree) -> float:
    """Share of a place's points with a point of the scan nearer than its radius."""
    radius = float(np.sqrt(((place - place.mean(axis=0)) ** 2).sum(axis=1).mean()))
    distance, _ = room.query(place, distance_upper_bound=radius)
    return float(np.isfinite(distance).mean())
