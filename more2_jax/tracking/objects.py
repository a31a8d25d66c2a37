"""The objects of a living scene: how they begin, gain observations, move between scans."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from more2_jax.geometry.poses import Points, Pose, apply_pose, rotation_error_deg, turned
from more2_jax.matching.color import color_of, pooled
from more2_jax.types import Embedding, Frame, Instance, Observation, ScanRecord, SceneObject

SCENE_FRAME = Frame()  # that of the first scan


def new_object(
    number: int, scan: int, instance: Instance, embedding: Embedding, frame: Frame = SCENE_FRAME
) -> SceneObject:
    """An object seen for the first time: this observation is its reference. `frame`: of the scan."""
    own = Observation(
        scan=scan,
        instance=instance.id,
        T_ref_scan=np.eye(4),
        score=1.0,
        rms_m=0.0,
        converged=True,
        frame=frame,
    )
    return SceneObject(
        id=f"object_{number:03d}",
        label=instance.label,
        reference_scan=scan,
        observations=(own,),
        points=instance.points,
        point_scan=np.full(len(instance.points), scan, np.int32),
        embedding=embedding,
        normals=instance.normals,
        color=color_of(instance.colors),
    )


def new_objects(
    first: int,
    scan: int,
    rows: Sequence[int],
    instances: Sequence[Instance],
    embeddings: Sequence[Embedding],
    frame: Frame = SCENE_FRAME,
) -> dict[int, SceneObject]:
    """By row, an object of every instance in `rows`, numbered from `first` on."""
    return {
        row: new_object(first + n, scan, instances[row], embeddings[row], frame) for n, row in enumerate(rows)
    }


def next_number(objects: Sequence[SceneObject], scans: Sequence[ScanRecord]) -> int:
    """One that no object has or had: ids of objects that were parts of others are not given again."""
    ids = [o.id for o in objects] + [id_ for s in scans for r in s.repairs for id_ in r.absorbed]
    return 1 + max(map(number_in, ids), default=-1)


def seen_again(o: SceneObject, instance: Instance, seen: Observation) -> SceneObject:
    """The object with one more observation; its mesh is out of date if that is accumulated."""
    return dataclasses.replace(
        o,
        observations=(*o.observations, seen),
        points=np.concatenate([o.points, apply_pose(seen.T_ref_scan, instance.points)]),
        point_scan=np.concatenate([o.point_scan, np.full(len(instance.points), seen.scan, np.int32)]),
        normals=all_normals(o, instance, seen.T_ref_scan),
        mesh=None if seen.accumulated else o.mesh,
        color=pooled(o.color, color_of(instance.colors)) if seen.accumulated else o.color,
    )


def all_normals(o: SceneObject, other: Instance | SceneObject, T_ref_other: Pose) -> Points | None:
    """The normals of the object's points and of another cloud's, in the object's frame; zeros where not known."""
    both = (o.points, o.normals), (other.points, turned(T_ref_other, other.normals))
    if all(normals is None for _, normals in both):
        return None
    return np.concatenate([np.zeros_like(p) if normals is None else normals for p, normals in both])


def accumulated(o: SceneObject) -> list[Observation]:
    """The observations that make up the object's shape; the reference is one of them."""
    return [seen for seen in o.observations if seen.accumulated]


def accumulated_points(o: SceneObject) -> Points:
    """The points of those observations, in the object's reference frame."""
    if all(seen.accumulated for seen in o.observations):
        return o.points
    return o.points[np.isin(o.point_scan, [seen.scan for seen in accumulated(o)])]


def accumulated_normals(o: SceneObject) -> Points | None:
    """The normals of the accumulated points; zeros where not known, None where the object has none."""
    if o.normals is None or all(seen.accumulated for seen in o.observations):
        return o.normals
    return o.normals[np.isin(o.point_scan, [seen.scan for seen in accumulated(o)])]


def points_of(o: SceneObject, seen: Observation) -> Points:
    """The points of one observation, in its scan's frame."""
    return apply_pose(np.linalg.inv(seen.T_ref_scan), o.points[o.point_scan == seen.scan])


def reference_pose(o: SceneObject) -> Pose:
    """T_ref_scan of the reference scan: the identity, but of a scan that was leveled."""
    seen = observation_in(o, o.reference_scan)
    return np.eye(4) if seen is None else seen.T_ref_scan


def number_of(o: SceneObject) -> int:
    """That of its id: 3 of `object_003`. It is no place in `LivingScene.objects`: joined parts leave gaps."""
    return number_in(o.id)


def number_in(id_: str) -> int:
    """3 of `object_003`."""
    return int(id_.rpartition("_")[2])


def observation_in(o: SceneObject, scan: int) -> Observation | None:
    """The object's observation in a scan, if it was there."""
    return next((seen for seen in o.observations if seen.scan == scan), None)


def place_of(seen: Observation) -> Pose:
    """T_scene_ref: takes an object's points to where an observation has them, in the scene's frame."""
    return seen.frame.T_scene_scan @ np.linalg.inv(seen.T_ref_scan)


def motion_between(o: SceneObject, before: Observation, after: Observation) -> tuple[float, float]:
    """How far (meters, at the object's mean) and by what angle (degrees) it moved, in the scene's frame."""
    first, then = place_of(before), place_of(after)
    center = accumulated_points(o).mean(axis=0, keepdims=True)
    distance = float(np.linalg.norm(apply_pose(then, center) - apply_pose(first, center)))
    return distance, float(rotation_error_deg(then[:3, :3], first[:3, :3]))
