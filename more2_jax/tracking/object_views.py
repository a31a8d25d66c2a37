"""What sensors saw of and around the instances of a new scan, and the objects of a living scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from more2_jax.geometry.free_space import Around, sight_of, spread, stacked, view_of
from more2_jax.geometry.near_points import NearPoints
from more2_jax.geometry.poses import Points, apply_pose
from more2_jax.geometry.transform import transform
from more2_jax.tracking.objects import accumulated, accumulated_points, points_of
from more2_jax.types import Instance, Scan, ScanRecord, SceneObject, Sight

SENSORS = 64  # of a scan that are remembered
REACH_M = 15.0  # of things farther off, in other rooms of a building, a sensor is not asked


def few_sensors(scan: Scan) -> Points:
    """The places of a scan's sensors, at even steps: `SENSORS` at most."""
    return scan.sensors[:: max(1, -(-len(scan.sensors) // SENSORS))]


def instance_sights(instances: Sequence[Instance], scan: Scan, background: Points) -> list[Sight | None]:
    """What the scan's sensors saw around each instance, in its frame. `background`: as the scene remembers it."""
    if not len(scan.sensors):
        return [None] * len(instances)
    room = NearPoints(np.concatenate([*(i.points for i in scan.instances), background]))
    sensors = few_sensors(scan)
    return [sight_near(i.points, room, sensors) for i in instances]


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


def object_sights(objects: Sequence[SceneObject], scans: Sequence[ScanRecord]) -> list[Sight | None]:
    """What was seen around each object, in its own frame, by the scans that make up its shape."""
    rooms = {s.index: _room(s, objects) for s in scans if len(s.sensors)}
    return [_object_sight(o, scans, rooms) for o in objects]


def _room(scan: ScanRecord, objects: Sequence[SceneObject]) -> NearPoints:
    """All points of a scan that the scene remembers, in the scan's frame."""
    there = [points_of(o, seen) for o in objects for seen in o.observations if seen.scan == scan.index]
    return NearPoints(np.concatenate([*there, scan.background]))


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
