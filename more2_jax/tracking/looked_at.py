"""Whether a scan can tell that it lacks an object: "removed" and "added" are said only of what was looked for.

A scan that saw a place has points there: of what stands there instead, or of the floor under it. If it has the
object's own surface there, it lacks a mask, not the object. Beyond the paper, which takes every scan to be complete and
every mask to be there.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from more2_jax.geometry.near_points import NearPoints, rms_radius
from more2_jax.geometry.poses import Points, apply_pose
from more2_jax.tracking.objects import accumulated_points, observation_in, place_of, points_of
from more2_jax.tracking.scan_noise import near_m
from more2_jax.tracking.surroundings import around
from more2_jax.types import Frame, Scan, ScanRecord, SceneObject

CELL_M = 0.15  # a side of a column of the place: scans hold a point every few centimeters
SPACINGS = 4.0  # between neighboring points, that a side has at least: four points of a floor in a column
STILL_THERE = 0.5  # share of an object's points that lie on a scan's surfaces: it stands there without a mask
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
    """Ids of those `missing` objects of which the scan, which lies in `frame`, cannot tell that they are gone.

    It did not look at their last place, or still shows their surface there. Where that cannot be asked, it is taken to
    have looked: without background, or where its frame or that of the last place is unknown.
    """
    missing = [k for k in missing if not objects[k].observations[-1].frame.unknown]
    if len(scan.background) < LEAST_BACKGROUND or frame.unknown or not len(missing):
        return ()

    def clouds() -> Iterator[Points]:
        for points in (scan.background, *(i.points for i in scan.instances)):
            yield apply_pose(frame.T_scene_scan, points)

    places = [last_place(objects[k]) for k in missing]
    unsure = cannot_tell(places, clouds, upright, noise_m=frame.noise_m)
    return tuple(objects[k].id for k, u in zip(missing, unsure, strict=True) if u)


def not_looked_at_before(
    objects: Sequence[SceneObject], fresh: Sequence[SceneObject], scans: Sequence[ScanRecord], upright: bool
) -> dict[int, tuple[str, ...]]:
    """By earlier scan, the ids of `fresh` objects of which it cannot tell that it lacked them, back to one that can.

    `objects`: those known before. What is taken to have looked is as for `not_looked_at`.
    """
    unseen = dict[int, tuple[str, ...]]()
    fresh = [o for o in fresh if not o.observations[-1].frame.unknown]
    for scan in reversed(scans):
        if not fresh or len(scan.background) < LEAST_BACKGROUND or scan.frame.unknown:
            break
        places, clouds = [last_place(o) for o in fresh], partial(clouds_of, objects, scan)
        noise_m = max(scan.frame.noise_m, *(o.observations[-1].frame.noise_m for o in fresh))
        unsure = cannot_tell(places, clouds, upright, spacing_of(scan.background), noise_m)
        fresh = [o for o, u in zip(fresh, unsure, strict=True) if u]
        unseen[scan.index] = tuple(o.id for o in fresh)
    return {index: ids for index, ids in unseen.items() if ids}


def with_not_seen(
    scans: Sequence[ScanRecord], *unseen: Mapping[int, tuple[str, ...]]
) -> tuple[ScanRecord, ...]:
    """The scans, with more objects, by scan, that they cannot tell they lack."""
    more = {s.index: tuple(id_ for u in unseen for id_ in u.get(s.index, ())) for s in scans}
    return tuple(
        dataclasses.replace(s, not_seen=(*s.not_seen, *more[s.index])) if more[s.index] else s for s in scans
    )


def clouds_of(objects: Sequence[SceneObject], scan: ScanRecord) -> Iterator[Points]:
    """What the scene remembers of a scan, in the scene's frame: its background, and its objects one by one."""
    yield apply_pose(scan.frame.T_scene_scan, scan.background)
    for o in objects:
        if (seen := observation_in(o, scan.index)) is not None:
            yield apply_pose(seen.frame.T_scene_scan, points_of(o, seen))


def cannot_tell(
    places: Sequence[Points],
    clouds: Callable[[], Iterator[Points]],
    upright: bool,
    spacing_m: float = 0.0,
    noise_m: float = 0.0,
) -> list[bool]:
    """Of objects at these places (scene's frame), whether a scan cannot tell that it lacks them.

    `clouds`: all that the scan shows, its background first. `spacing_m`: between neighboring points of that, where it
    was thinned, `noise_m`: between it and where the places were seen. Columns, and what is near, are as wide as they
    need be.
    """
    if upright:
        room = Columns(clouds(), max(CELL_M, SPACINGS * spacing_m))
        shares = [looked_at_upright(p, room) for p in places]
    else:
        tree = KDTree(np.concatenate(list(clouds())))
        shares = [looked_at(p, tree) for p in places]
    there = shares_still_there(places, clouds(), max(near_m(noise_m), spacing_m))
    return [seen < LOOKED_AT or still >= STILL_THERE for seen, still in zip(shares, there, strict=True)]


def shares_still_there(
    places: Sequence[Points],
    clouds: Iterator[Points],
    near_m: float,
    but: Sequence[Collection[int]] | None = None,
) -> list[float]:
    """Shares of places that lie on surfaces of a scan; the rest as for `distances_to_shown`."""
    return [
        float(np.isfinite(distance).mean()) for distance in distances_to_shown(places, clouds, near_m, but)
    ]


def distances_to_shown(
    places: Sequence[Points],
    clouds: Iterator[Points],
    reach_m: float,
    but: Sequence[Collection[int]] | None = None,
) -> list[Float[np.ndarray, " _"]]:
    """How far every point of places is from surfaces of a scan other than floor and walls, infinite beyond `reach_m`.

    The first cloud is the scan's background. Of the other clouds, one after the other, only what lies about the places
    is held. `but`: of each place, the numbers of the clouds, background aside, that do not count.
    """
    background = NearPoints(next(clouds))
    first, last = (np.array([f(p, axis=0) for p in places]).reshape(-1, 3) for f in (np.min, np.max))
    first, last = first - reach_m, last + reach_m
    but = [()] * len(places) if but is None else but
    beside: list[list[Points]] = [[np.zeros((0, 3))] for _ in places]
    for n, cloud in ((n, c) for n, c in enumerate(clouds) if len(c)):
        low, high = cloud.min(axis=0), cloud.max(axis=0)
        for at in np.flatnonzero(((low <= last) & (first <= high)).all(axis=1)).tolist():
            if n not in but[at]:
                inside = (cloud >= first[at]) & (cloud <= last[at])
                beside[at].append(cloud[inside.all(axis=1)])
    distances = list[Float[np.ndarray, " n"]]()
    for place, parts in zip(places, beside, strict=True):
        surfaces = around(place, background, np.concatenate(parts), background)
        distances.append(KDTree(surfaces).query(place, distance_upper_bound=reach_m)[0])
    return distances


def spacing_of(background: Points) -> float:
    """Distance between neighbors of the points that are remembered of a scan, which are few in a building; meters."""
    some = background[:: max(1, len(background) // 1000)]
    distance, _ = KDTree(background).query(some, k=2)
    return float(np.median(distance[:, 1]))


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
    distance, _ = room.query(place, distance_upper_bound=rms_radius(place))
    return float(np.isfinite(distance).mean())
