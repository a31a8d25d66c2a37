"""Points of a mask that are floor or wall: left out before an instance is compared with anything.

Beyond the paper, which takes masks as true. A patch of floor beside a chair leg goes on in the scan's background, in
one plane behind which the scan has nothing (`geometry.room_planes`): a single scan shows that.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from jaxtyping import Bool
from scipy.spatial import KDTree

from more2_jax.geometry.near_points import CELL_M, NearClouds
from more2_jax.geometry.poses import Points
from more2_jax.geometry.room_planes import AROUND_M, on_planes, room_planes, within
from more2_jax.tracking.scan_nearby import shown_near
from more2_jax.types import Instance, Repair, SceneObject

Rows = Bool[np.ndarray, " n"]

MOST_DROPPED = 0.5  # share of a mask: what lies more in a wall or floor than off it is a picture, or a rug
LEAST_DROPPED = 0.01  # share of a mask: fewer are no patch, and as likely its own
# Of a scan's background, kept for the page and for free space: so many, or of a building so many a cell of a meter.
BACKGROUND_POINTS, POINTS_A_CELL = 20_000, 100
COUNTED = 200_000  # points that tell how many cells there are
BESIDE_M = 0.1  # of a mask: background that tells which way its points face


@dataclass(frozen=True, kw_only=True)
class Dropped:
    """Points of one mask that were left out."""

    count: int
    points: int  # of the mask, before
    sure: float  # share of those dropped, within half the tolerance


@dataclass(frozen=True, kw_only=True)
class Cleared:
    """Instances without floor and walls, and what was dropped, by their ids."""

    instances: list[Instance]
    dropped: dict[int, Dropped] = field(default_factory=dict)

    def repairs(
        self, scan: int, objects: Sequence[SceneObject], joined: Sequence[Repair] = ()
    ) -> tuple[Repair, ...]:
        """What was dropped, said of the objects that the scan's instances turned out to be, or (`joined`) parts of."""
        names = {i: r.object for r in joined for i in r.instances}
        names |= {s.instance: o.id for o in reversed(objects) for s in o.observations if s.scan == scan}
        return tuple(
            Repair(object=names[i], instances=(i,), dropped=d.count, points=d.points, share=d.sure)
            for i, d in self.dropped.items()
            if i in names
        )


def remembered(background: Points) -> Points:
    """Returns every k-th point of a scan's background: `BACKGROUND_POINTS` at most, of a building more.

    Rooms have 40 to 140 cells of a meter that hold surfaces: those of a building are about as dense as one alone.
    """
    if len(background) <= BACKGROUND_POINTS:
        return background
    some = background[:: max(1, len(background) // COUNTED)]
    cells = len(np.unique(np.floor(some / CELL_M).astype(np.int64), axis=0))
    most = max(BACKGROUND_POINTS, POINTS_A_CELL * cells)
    return background[:: max(1, -(-len(background) // most))]


def without_room(instances: Sequence[Instance], background: Points, fewest: int) -> Cleared:
    """The instances of a scan without points of floor and walls; all in its frame, meters.

    One that would keep fewer than `fewest` points, or lose hardly any or most of them, stays whole.
    """
    clouds = [partial(getattr, i, "points") for i in instances]
    scan = NearClouds(clouds, background)
    cleared, dropped = list[Instance](), dict[int, Dropped]()
    for i, room in zip(instances, shown_near(clouds, scan, AROUND_M), strict=True):
        among = np.concatenate([i.points, within(KDTree(i.points), scan.rest, BESIDE_M)])
        on, sure = on_planes(i.points, room_planes(i.points, scan.rest, room), among)
        if LEAST_DROPPED <= on.mean() <= MOST_DROPPED and (~on).sum() >= fewest:
            dropped[i.id] = Dropped(count=int(on.sum()), points=len(on), sure=float(sure.sum() / on.sum()))
            cleared.append(some_points(i, ~on))
        else:
            cleared.append(i)
    return Cleared(instances=cleared, dropped=dropped)


def some_points(instance: Instance, rows: Rows) -> Instance:
    """Some points of an instance, with its id."""
    per_point = {name: getattr(instance, name) for name in ("points", "colors", "normals")}
    return dataclasses.replace(
        instance, **{name: None if x is None else x[rows] for name, x in per_point.items()}
    )
