"""What sensors saw of and around the instances of a new scan, and the objects of a living scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from more2_jax.geometry.free_space import sight_of, spread, stacked, view_of
from more2_jax.geometry.poses import Points, apply_pose
from more2_jax.geometry.transform import transform
from more2_jax.tracking.objects import accumulated, accumulated_points, points_of
from more2_jax.types import Instance, Scan, ScanRecord, SceneObject, Sight

SENSORS = 64  # of a scan that are remembered


def few_sensors(scan: Scan) -> Points:
    """The places of a scan's sensors, at even steps: `SENSORS` at most."""
    return scan.sensors[:: max(1, -(-len(scan.sensors) // SENSORS))]


def instance_sights(instances: Sequence[Instance], scan: Scan, background: Points) -> list[Sight | None]:
    """What the scan's sensors saw around each instance, in its frame. `background`: as the scene remembers it."""
    if not len(scan.sensors):
        return [None] * len(instances)
    room = np.concatenate([*(i.points for i in scan.instances), background])
    sensors = few_sensors(scan)
    return [sight_of(i.points, room, sensors) for i in instances]


def object_sights(objects: Sequence[SceneObject], scans: Sequence[ScanRecord]) -> list[Sight | None]:
    """What was seen around each object, in its own frame, by the scans that make up its shape."""
    rooms = {s.index: _room(s, objects) for s in scans if len(s.sensors)}
    return [_object_sight(o, scans, rooms) for o in objects]


def _room(scan: ScanRecord, objects: Sequence[SceneObject]) -> Points:
    """All points of a scan that the scene remembers, in the scan's frame."""
    there = [points_of(o, seen) for o in objects for seen in o.observations if seen.scan == scan.index]
    return np.concatenate([*there, scan.background])


def _object_sight(o: SceneObject, scans: Sequence[ScanRecord], rooms: dict[int, Points]) -> Sight | None:
    """The views of its accumulated observations that lie farthest apart."""
    eyes = [(seen, eye) for seen in accumulated(o) if seen.scan in rooms for eye in scans[seen.scan].sensors]
    around = [apply_pose(seen.T_ref_scan, eye[None])[0] for seen, eye in eyes]
    views = []
    for seen, eye in (eyes[k] for k in spread(around, accumulated_points(o).mean(axis=0))):
        view = view_of(points_of(o, seen), rooms[seen.scan], eye)
        if view is not None:
            views.append(transform(view, seen.T_ref_scan))
    return stacked(views)
