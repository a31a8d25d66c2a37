"""What sensors saw of and around the instances of a new scan, and the objects of a living scene."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, partial

import numpy as np
from jaxtyping import Float

from more2_jax.geometry.free_space import Around, sight_of, spread, stacked, view_of
from more2_jax.geometry.near_points import NearClouds, NearPoints
from more2_jax.geometry.poses import Points, apply_pose
from more2_jax.geometry.transform import transform
from more2_jax.tracking.objects import accumulated, accumulated_points, points_of
from more2_jax.types import Instance, Scan, ScanRecord, SceneObject, Sight

SENSORS = 64  # of a scan that are remembered
REACH_M = 15.0  # of things farther off, in other rooms of a building, a sensor is not asked
NOTHING = np.zeros((0, 3))
Rows = Sequence[int]


class Views:
    """What sensors saw of the objects of a scene, and of the instances of a new scan, told of those asked about.

    Of a scan only what lies near those is put in order.
    """

    def __init__(
        self,
        objects: Sequence[SceneObject],
        scans: Sequence[ScanRecord],
        instances: Sequence[Instance] = (),
        scan: Scan | None = None,
        background: Points = NOTHING,
    ) -> None:
        """`instances`: of `scan`, the new one. `background`: of that, as the scene remembers it."""
        self.objects, self.scans = objects, scans
        self.instances, self.scan, self.background = instances, scan, background

    def of_objects(self, rows: Rows | None = None) -> list[Sight | None]:
        """What was seen around some objects, or all, each in its own frame, by the scans that make up its shape."""
        some = [self.objects[k] for k in (range(len(self.objects)) if rows is None else rows)]
        places = {s: [] for s in self._rooms}
        for o in some:
            for seen in accumulated(o):
                if seen.scan in places:
                    places[seen.scan].append(points_of(o, seen).mean(axis=0))
        near = {s: self._rooms[s].near(at, REACH_M) for s, at in places.items()}
        return [_object_sight(o, self.scans, near) for o in some]

    def of_instances(self, rows: Rows | None = None) -> list[Sight | None]:
        """What the new scan's sensors saw around some instances, or all, in its frame."""
        some = [self.instances[i].points for i in (range(len(self.instances)) if rows is None else rows)]
        if self.scan is None or not len(self.scan.sensors):
            return [None] * len(some)
        near, sensors = self._room.near([p.mean(axis=0) for p in some], REACH_M), few_sensors(self.scan)
        return [sight_near(p, near, sensors) for p in some]

    @cached_property
    def _rooms(self) -> dict[int, NearClouds]:
        return {s.index: _room(s, self.objects) for s in self.scans if len(s.sensors)}

    @cached_property
    def _room(self) -> NearClouds:
        assert self.scan is not None
        return NearClouds([partial(_given, i.points) for i in self.scan.instances], self.background)


def few_sensors(scan: Scan) -> Points:
    """The places of a scan's sensors, at even steps: `SENSORS` at most."""
    return scan.sensors[:: max(1, -(-len(scan.sensors) // SENSORS))]


def sight_near(cloud: Points, room: NearPoints, sensors: Points) -> Sight | None:
    """`sight_of` by what stands within `REACH_M` of a cloud."""
    center = cloud.mean(axis=0)
    near = within_reach(sensors, center)
    return sight_of(cloud, around(room, center), near) if len(near) else None


def around(room: NearPoints, center: Float[np.ndarray, "3"]) -> Around:
    """What of a scan lies within `REACH_M` of a place."""
    return Around(scan=room, cells=room.cells_around(center, REACH_M))


def within_reach(sensors: Points, center: Float[np.ndarray, "3"]) -> Points:
    """The sensors that are not too far from a place to tell of it."""
    return sensors[np.linalg.norm(sensors - center, axis=1) <= REACH_M]


def _room(scan: ScanRecord, objects: Sequence[SceneObject]) -> NearClouds:
    """All points of a scan that the scene remembers, in the scan's frame."""
    there = [(o, seen) for o in objects for seen in o.observations if seen.scan == scan.index]
    return NearClouds([partial(points_of, o, seen) for o, seen in there], scan.background)


def _given(points: Points) -> Points:
    return points


def _object_sight(o: SceneObject, scans: Sequence[ScanRecord], rooms: dict[int, NearPoints]) -> Sight | None:
    """The views of its accumulated observations that lie farthest apart."""
    shown = {seen.scan: points_of(o, seen) for seen in accumulated(o) if seen.scan in rooms}
    eyes = [
        (seen, eye)
        for seen in accumulated(o)
        if seen.scan in rooms
        for eye in within_reach(scans[seen.scan].sensors, shown[seen.scan].mean(axis=0))
    ]
    places = [apply_pose(seen.T_ref_scan, eye[None])[0] for seen, eye in eyes]
    views, near = [], dict[int, Around]()
    for seen, eye in (eyes[k] for k in spread(places, accumulated_points(o).mean(axis=0))):
        cloud = shown[seen.scan]
        if seen.scan not in near:
            near[seen.scan] = around(rooms[seen.scan], cloud.mean(axis=0))
        view = view_of(cloud, near[seen.scan], eye)
        if view is not None:
            views.append(transform(view, seen.T_ref_scan))
    return stacked(views)
