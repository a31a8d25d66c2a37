"""Borders of masks, mended by what other scans show of the objects: points of neighbors go, what was cut off returns.

Beyond the paper, which takes masks as true. At the pose at which an object was registered, the other scans say what
belongs to it. That they do not show a point is no reason to drop it: it may be a side that they did not see. It goes if
they show it on another object. What is no object comes back if they show the object there, and it is no floor or wall.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from more2_jax.geometry.near_points import NearClouds, NearPoints
from more2_jax.geometry.poses import Points, apply_pose
from more2_jax.geometry.room_planes import AROUND_M, on_planes, room_planes, within
from more2_jax.tracking.objects import accumulated
from more2_jax.tracking.room_points import remembered
from more2_jax.tracking.scan_nearby import shown_near
from more2_jax.tracking.split_masks import reach_m
from more2_jax.types import Observation, Repair, SceneObject

Rows = Bool[np.ndarray, " n"]
Distances = Float[np.ndarray, " n"]

# Chosen on rooms of regime `real`, docs/developing/notebook/mask_repair.md. What lies on an object:
# `split_masks.reach_m`.
MOST_DROPPED = 0.35  # share of a mask that may be its neighbors': where more is, it is two objects in one
LEAST_CHANGED = 0.02  # share of a mask, that is lost or comes back: fewer points are as likely wrong
TOUCHING = 2.0  # times the spacing of its points: what lies so near a cloud goes on in it
GOES_ON = (
    0.3  # as many points must touch the neighbor's own, as a share of those that touch the rest of the mask
)
BESIDE_M = 0.15  # of what may come back: points that tell how it faces


@dataclass(frozen=True, kw_only=True)
class View:
    """One object as one scan shows it, and as the other scans do; in that scan's frame, meters.

    Points are moved when they are asked for: those of all objects are not in memory twice.
    """

    row: int  # of the object
    object: SceneObject
    seen: Observation
    count: int  # of its own points
    reach_m: float  # so near the points of others lies what they show of the object

    @property
    def scan(self) -> int:
        """That is looked at."""
        return self.seen.scan

    @property
    def own(self) -> Points:
        """What that scan shows of it."""
        return self._there(self.object.point_scan == self.scan)

    @property
    def others(self) -> Points:
        """What the other scans show that make up its shape."""
        shape = np.isin(self.object.point_scan, [s.scan for s in accumulated(self.object)])
        return self._there(shape & (self.object.point_scan != self.scan))

    @property
    def whole(self) -> Points:
        """What that scan and the others show."""
        return np.concatenate([self.own, self.others])

    def _there(self, rows: Rows) -> Points:
        return apply_pose(np.linalg.inv(self.seen.T_ref_scan), self.object.points[rows])


@dataclass(frozen=True, kw_only=True)
class Border:
    """What one mask loses to a neighbor, or gains."""

    view: View
    points: Points  # in the scan's frame
    sure: float  # share of them that lie within half the reach of the object that they are of
    rows: Rows  # of the mask, that are lost; none where points are gained
    neighbor: str | None = None  # id of the object that they are of, where they are lost

    def repair(self, scan: int) -> Repair:
        """As scan `scan` led to it."""
        v, count = self.view, len(self.points)
        return Repair(
            object=v.object.id,
            instances=(v.seen.instance,) if v.scan == scan else (),
            dropped=count if self.neighbor else 0,
            neighbor=self.neighbor,
            regained=0 if self.neighbor else count,
            points=v.count,
            share=self.sure,
        )


def mend_borders(
    objects: Sequence[SceneObject], found: Sequence[int], scan: int, backgrounds: Mapping[int, Points]
) -> tuple[list[SceneObject], tuple[Repair, ...]]:
    """The objects with better points of what scan `scan` saw of them, and of what one earlier scan alone had seen.

    `found`: rows of the objects that it shows again. `backgrounds`: of those scans all that is no object, in their
    frames. Observations that are not accumulated, as their poses are in doubt, say nothing and stay as they are.
    """
    pairs = {(s, k) for k in found for s in scans_to_mend(objects[k], scan)}
    scans = sorted({s for s, _ in pairs})
    lost = [b for s in scans for b in lost_to_neighbors(list(views_of(objects, pairs, s)))]
    kept = with_borders(objects, lost)
    gained = []
    for s in scans:
        loose = np.concatenate([backgrounds[s], *(b.points for b in lost if b.view.scan == s)])
        gained += regained(list(views_of(kept, pairs, s)), loose, backgrounds[s])
    return with_borders(kept, gained), tuple(b.repair(scan) for b in (*lost, *gained))


def scans_to_mend(o: SceneObject, scan: int) -> list[int]:
    """The scan, and the only other one that saw the object, if both make up its shape."""
    seen = [s.scan for s in accumulated(o)]
    if scan not in seen or len(seen) < 2:
        return []
    return seen if len(o.observations) == 2 else [scan]


def views_of(objects: Sequence[SceneObject], pairs: set[tuple[int, int]], scan: int) -> Iterator[View]:
    """The objects whose observations in one scan are to be mended, by rows in order."""
    for k in sorted(row for s, row in pairs if s == scan):
        o = objects[k]
        seen = next(s for s in o.observations if s.scan == scan)
        count = int((o.point_scan == scan).sum())
        view = View(row=k, object=o, seen=seen, count=count, reach_m=0.0)
        yield dataclasses.replace(view, reach_m=reach_m(view.others))


# --- what goes ----------------------------------------------------------------------------------------------


def lost_to_neighbors(views: Sequence[View]) -> list[Border]:
    """Points that the other scans do not show on their object, but on another one that goes on beside them."""
    borders, meeting = [], boxes_meet(views)
    for v, met in zip(views, meeting, strict=True):
        own = v.own
        free = off(own, v.others, v.reach_m) > v.reach_m
        lost = list[Border]()
        for w in (w for w, m in zip(views, met, strict=True) if m and w is not v):
            if (b := lost_to(v, own, free, w)) is not None:
                lost.append(b)
                free &= ~b.rows
        if sum(len(b.points) for b in lost) <= MOST_DROPPED * len(own):
            borders += lost
    return borders


def boxes_meet(views: Sequence[View]) -> Bool[np.ndarray, "v v"]:
    """Whether the mask of one view (row) may have points within reach of what the others show of another (column)."""
    if not views:
        return np.zeros((0, 0), bool)
    low, high = (x[:, None] for x in boxes(v.own for v in views))
    there, beyond = boxes(v.others for v in views)
    reach = np.array([v.reach_m for v in views])[:, None]
    return np.all((low <= beyond + reach) & (high >= there - reach), axis=-1)


def boxes(clouds: Iterable[Points]) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v 3"]]:
    """The lowest and highest corners of clouds; one of them is in memory at a time."""
    low, high = zip(*((c.min(axis=0), c.max(axis=0)) for c in clouds), strict=True)
    return np.stack(low), np.stack(high)


def lost_to(v: View, own: Points, free: Rows, w: View) -> Border | None:
    """Which of the `free` points of a mask (`own`) are those of one neighbor; None of none.

    They must go on in what the scan itself has of the neighbor: another scan's mask may be the one that is wrong.
    """
    distance = np.full(len(free), np.inf)
    distance[free] = off(own[free], w.others, w.reach_m)
    rows = distance <= w.reach_m
    if rows.mean() < LEAST_CHANGED or rows.all():
        return None
    points, touching = own[rows], TOUCHING * spacing(own)
    there, here = (np.isfinite(off(points, p, touching)).sum() for p in (w.own, own[~rows]))
    if not there or there < GOES_ON * here:
        return None
    sure = float((distance[rows] <= w.reach_m / 2).mean())
    return Border(view=v, points=points, sure=sure, neighbor=w.object.id, rows=rows)


def spacing(points: Points) -> float:
    """Median distance to the nearest other point, meters."""
    return float(np.median(KDTree(points).query(points, k=2)[0][:, 1]))


# --- what comes back ----------------------------------------------------------------------------------------


def regained(views: Sequence[View], loose: Points, background: Points) -> list[Border]:
    """Points of no object that lie where the other scans show one; of several that which is nearest.

    `loose`: all points of the scan that are no object's. Floor and walls, sought in the `background`, stay there.
    """
    scan = NearClouds([partial(getattr, v, "own") for v in views], remembered(background))
    near = NearPoints(loose)  # of a building little lies about one object
    rooms = shown_near([partial(getattr, v, "whole") for v in views], scan, AROUND_M)
    nearest, owner = np.full(len(loose), np.inf), np.full(len(loose), -1)
    for n, (v, room) in enumerate(zip(views, rooms, strict=True)):
        own, others = v.own, v.others
        rows = near.rows_around_box(others.min(axis=0) - v.reach_m, others.max(axis=0) + v.reach_m)
        distance = off(loose[rows], others, v.reach_m)
        closer = distance < nearest[rows]
        rows, distance = rows[closer], distance[closer]
        among = np.concatenate([own, within(KDTree(others), near, v.reach_m + BESIDE_M)])
        planes = room_planes(v.whole, scan.rest, room) if len(rows) else []
        free = ~on_planes(loose[rows], planes, among)[0]
        nearest[rows[free]], owner[rows[free]] = distance[free], n
    return [
        Border(
            view=v,
            points=loose[rows],
            sure=float((nearest[rows] <= v.reach_m / 2).mean()),
            rows=np.zeros(v.count, bool),
        )
        for n, v in enumerate(views)
        if (rows := owner == n).sum() >= LEAST_CHANGED * v.count
    ]


def off(points: Points, cloud: Points, reach_m: float) -> Distances:
    """How far points lie off a cloud; infinite beyond a reach."""
    distance = np.full(len(points), np.inf)
    box = ((points >= cloud.min(axis=0) - reach_m) & (points <= cloud.max(axis=0) + reach_m)).all(axis=1)
    if box.any():
        distance[box] = KDTree(cloud).query(points[box], distance_upper_bound=reach_m)[0]
    return distance


# --- records ------------------------------------------------------------------------------------------------


def with_borders(objects: Sequence[SceneObject], borders: Sequence[Border]) -> list[SceneObject]:
    """The objects without the points that were lost, and with those that were gained; these have no known normals."""
    changed = list(objects)
    for k in sorted({b.view.row for b in borders}):
        o, own = objects[k], [b for b in borders if b.view.row == k]
        kept = np.ones(len(o.points), bool)
        for b in own:
            kept[np.flatnonzero(o.point_scan == b.view.scan)[b.rows]] = False
        more = [b for b in own if b.neighbor is None]
        points = [apply_pose(b.view.seen.T_ref_scan, b.points) for b in more]
        normals = (
            None if o.normals is None else np.concatenate([o.normals[kept], *map(np.zeros_like, points)])
        )
        changed[k] = dataclasses.replace(
            o,
            points=np.concatenate([o.points[kept], *points]),
            point_scan=np.concatenate(
                [o.point_scan[kept], *(np.full(len(b.points), b.view.scan, np.int32) for b in more)]
            ),
            normals=normals,
            mesh=None,
        )
    return changed
