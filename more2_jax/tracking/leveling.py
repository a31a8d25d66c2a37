"""Scans of upright things leveled before they are compared; what was found, told of the scans as they were given.

Beyond the paper. Things that turn about the vertical only need one vertical in all scans: by each scan's floors.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from more2_jax.geometry.gravity import Gravity, gravity, least_turn, stand_on_floor
from more2_jax.geometry.poses import Points, Pose, apply_pose, turned
from more2_jax.geometry.up_axis import likely_up_axis
from more2_jax.types import Frame, Instance, LivingScene, Observation, Scan, SceneObject

LEAST_TILT_DEG = 0.5  # a smaller tilt is left alone: clean scans stay as they are
# Of objects whose up tells that of a scan without floors, and the tilt that they tell for sure.
LEAST_AGREEING, AGREE_DEG, SURE_TILT_DEG = 2, 5.0, 2.0


def shows_floor(scan: Scan) -> bool:
    """Whether a scan's z is up, to some degrees, by a floor on which all it shows stands.

    It is then taken that things turn about the vertical only. A wall at the end of a scan that lies on its side is no
    floor: another axis is likelier up.
    """
    found = gravity(scan.background)
    if found is None:
        return False
    points = np.concatenate([scan.background, *(i.points for i in scan.instances)])
    likely, _ = likely_up_axis(points @ least_turn(found.up).T)
    return likely in ("+z", None) and stand_on_floor(points, found.up)


def level_of(background: Points, T_level_first: Pose | None = None) -> Pose:
    """T_level_scan: takes a scan to where its floors are level, about the middle of its background.

    `T_level_first` is that of the scene's first scan. Where it levels this one too, to `LEAST_TILT_DEG`, or up is not
    known here, both are taken to share a frame, and go on sharing it. Of a first scan it is the identity.
    """
    T_level_first = np.eye(4) if T_level_first is None else T_level_first
    found = gravity(background)
    if found is None:
        return T_level_first
    left = dataclasses.replace(found, up=T_level_first[:3, :3] @ found.up)
    if left.tilt_deg < LEAST_TILT_DEG:
        return T_level_first
    return np.eye(4) if found.tilt_deg < LEAST_TILT_DEG else found.level(np.median(background, axis=0))


def tells_up(background: Points) -> bool:
    """Whether a scan's floors, or its ceiling, tell where up is."""
    return gravity(background) is not None


def level_by_objects(scene: LivingScene, scan: Scan) -> Pose | None:
    """T_level_scan of a scene's last scan, by the objects that were found in it in any orientation.

    Each has an up of its own there: that of its reference observation. None unless half of them, and
    `LEAST_AGREEING`, agree within `AGREE_DEG`. That of the first scan, where it levels this one too.
    """
    seen = [o.observations[-1] for o in scene.objects if o.reference_scan != len(scene.scans) - 1]
    ups = np.array([s.T_ref_scan[2, :3] for s in seen if s.scan == len(scene.scans) - 1]).reshape(-1, 3)
    agree = ups @ ups.T > np.cos(np.deg2rad(AGREE_DEG))
    count = agree.sum(axis=1)
    if not len(ups) or count.max() < max(LEAST_AGREEING, len(ups) / 2):
        return None
    up = ups[agree[count.argmax()]].mean(axis=0)
    found = Gravity(up=up / np.linalg.norm(up), share=0.0)
    T_level_first = scene.scans[0].frame.T_scene_scan
    if dataclasses.replace(found, up=T_level_first[:3, :3] @ found.up).tilt_deg < SURE_TILT_DEG:
        return T_level_first
    return found.level(np.median(np.concatenate([i.points for i in scan.instances]), axis=0))


def is_level(T_level_scan: Pose) -> bool:
    """Whether a scan is compared as it was given."""
    return np.array_equal(T_level_scan, np.eye(4))


def leveled(scan: Scan, T_level_scan: Pose) -> Scan:
    """The scan, leveled: instances, background and sensors."""
    if is_level(T_level_scan):
        return scan
    return dataclasses.replace(
        scan,
        instances=tuple(leveled_instance(i, T_level_scan) for i in scan.instances),
        background=apply_pose(T_level_scan, scan.background),
        sensors=apply_pose(T_level_scan, scan.sensors),
    )


def leveled_instance(i: Instance, T_level_scan: Pose) -> Instance:
    """One instance of a leveled scan."""
    return dataclasses.replace(
        i, points=apply_pose(T_level_scan, i.points), normals=turned(T_level_scan, i.normals)
    )


def as_given(
    objects: Sequence[SceneObject], scan: int, frame: Frame, T_level_scan: Pose
) -> tuple[list[SceneObject], Frame]:
    """Objects and frame in terms of a scan as it was given, by those in terms of the leveled one.

    Points, codes and meshes stay where they are: in the frame of a leveled scan.
    """
    if is_level(T_level_scan):
        return list(objects), frame
    frame = dataclasses.replace(frame, T_scene_scan=frame.T_scene_scan @ T_level_scan)

    def told(seen: Observation) -> Observation:
        if seen.scan != scan:
            return seen
        return dataclasses.replace(seen, T_ref_scan=seen.T_ref_scan @ T_level_scan, frame=frame)

    poses = [tuple(told(seen) for seen in o.observations) for o in objects]
    return [dataclasses.replace(o, observations=p) for o, p in zip(objects, poses, strict=True)], frame
