"""Whether a scan looked at the place of an object: "removed" and "added" are said only of what was looked for.

A scan that saw a place has points there: of the object, of what stands there instead, or of the floor under it. Beyond
the paper, which takes every scan to be complete.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from more2_jax.geometry.poses import Points, apply_pose
from more2_jax.tracking.objects import accumulated_points, observation_in, place_of, points_of
from more2_jax.types import Frame, Scan, ScanRecord, SceneObject

CELL_M = 0.15  # a side of a column of the place: scans hold a point every few centimeters
SPACINGS = 4.0  # between neighboring points, that a side has at least: four points of a floor in a column
ABOVE_M = 0.1  # over an object's top: points higher than that tell nothing of its place
LOOKED_AT = 0.35  # share of the place that a scan must have looked at to miss the object
LEAST_BACKGROUND = 200  # points: a scan of objects alone does not tell where it looked


def not_looked_at(
    objects: Sequence[SceneObject],
    missing: Sequence[int],
    scan: Scan,
    frame: Frame,
    upright: bool,
) -> tuple[str, ...]:
    """Ids of those `missing` objects whose last place the scan, which lies in `frame`, did not look at.

    A scan without background, or of unknown frame, is taken to have looked everywhere.
    """
    if len(scan.background) < LEAST_BACKGROUND or frame.unknown or not len(missing):
        return ()
    clouds = (scan.background, *(i.points for i in scan.instances))
    share = share_looked_at((apply_pose(frame.T_scene_scan, points) for points in clouds), upright)
    return tuple(objects[k].id for k in missing if share(last_place(objects[k])) < LOOKED_AT)


def not_looked_at_before(
    objects: Sequence[SceneObject], fresh: Sequence[SceneObject], scans: Sequence[ScanRecord], upright: bool
) -> dict[int, tuple[str, ...]]:
    """By earlier scan, the ids of `fresh` objects whose place it did not look at: of the scans since one that did.

    `objects`: those known before. What is taken to have looked is as for `not_looked_at`.
    """
    unseen = dict[int, tuple[str, ...]]()
    for scan in reversed(scans):
        if not fresh or len(scan.background) < LEAST_BACKGROUND or scan.frame.unknown:
            break
        share = share_looked_at(clouds_of(objects, scan), upright, column_side_m(scan.background))
        fresh = [o for o in fresh if share(last_place(o)) < LOOKED_AT]
        unseen[scan.index] = tuple(o.id for o in fresh)
    return {index: ids for index, ids in unseen.items() if ids}


def with_not_seen(
    scans: Sequence[ScanRecord], unseen: Mapping[int, tuple[str, ...]]
) -> tuple[ScanRecord, ...]:
    """The scans, with more objects whose place they did not look at."""
    return tuple(
        dataclasses.replace(s, not_seen=(*s.not_seen, *unseen[s.index])) if s.index in unseen else s
        for s in scans
    )


def clouds_of(objects: Sequence[SceneObject], scan: ScanRecord) -> Iterator[Points]:
    """What the scene remembers of a scan, in the scene's frame: its background, and its objects one by one."""
    yield apply_pose(scan.frame.T_scene_scan, scan.background)
    for o in objects:
        if (seen := observation_in(o, scan.index)) is not None:
            yield apply_pose(seen.frame.T_scene_scan, points_of(o, seen))


def share_looked_at(
    clouds: Iterable[Points], upright: bool, side_m: float = CELL_M
) -> Callable[[Points], float]:
    """What share of a place (scene's frame) a scan looked at that has these points."""
    if upright:
        return partial(looked_at_upright, room=Columns(clouds, side_m))
    return partial(looked_at, room=KDTree(np.concatenate(list(clouds))))


def column_side_m(background: Points) -> float:
    """Wide enough for the points that are remembered of a scan, which are few in a building."""
    some = background[:: max(1, len(background) // 1000)]
    distance, _ = KDTree(background).query(some, k=2)
    return max(CELL_M, SPACINGS * float(np.median(distance[:, 1])))


def last_place(o: SceneObject) -> Points:
    """The object's points where it was seen last, in the scene's frame."""
    return apply_pose(place_of(o.observations[-1]), accumulated_points(o))


def looked_at_upright(place: Points, room: Columns) -> float:
    """Share of the columns under a place (z up) that hold points of the scan, not all of them over its top."""
    lowest = room.lowest_m(place)
    return float((lowest < place[:, 2].max() + ABOVE_M).mean())


class Columns:
    """The lowest point of a scan in every column, z up. Its clouds are looked at one by one."""

    def __init__(self, clouds: Iterable[Points], side_m: float = CELL_M) -> None:
        self._side_m = side_m
        self._lowest: dict[tuple[int, ...], float] = {}
        for points in (c for c in clouds if len(c)):
            cell = self._columns(points)
            order = np.lexsort((points[:, 2], cell[:, 1], cell[:, 0]))
            first = order[np.r_[True, (np.diff(cell[order], axis=0) != 0).any(axis=1)]]
            for column, z in zip(map(tuple, cell[first].tolist()), points[first, 2].tolist(), strict=True):
                self._lowest[column] = min(z, self._lowest.get(column, np.inf))

    def lowest_m(self, place: Points) -> Float[np.ndarray, " c"]:
        """Of every column that holds a point of a place, the height of the scan's lowest; infinite without any."""
        wanted = np.unique(self._columns(place), axis=0).tolist()
        return np.array([self._lowest.get(tuple(c), np.inf) for c in wanted])

    def _columns(self, points: Points) -> Int[np.ndarray, "n 2"]:
        return np.floor(points[:, :2] / self._side_m).astype(np.int64)


def looked_at(place: Points, room: KDTree) -> float:
    """Share of a place's points with a point of the scan nearer than its radius."""
    radius = float(np.sqrt(((place - place.mean(axis=0)) ** 2).sum(axis=1).mean()))
    distance, _ = room.query(place, distance_upper_bound=radius)
    return float(np.isfinite(distance).mean())
