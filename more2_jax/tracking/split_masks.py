"""Masks that show one object in pieces: found by the whole that another scan saw, and joined.

Beyond the paper, which takes masks as true. Two instances of one scan that lie on one object in one pose are one
object: they cannot both be there otherwise.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from more2_jax.geometry.near_points import NearClouds, rms_radius
from more2_jax.geometry.poses import Points, Pose, apply_pose
from more2_jax.matching.color import pooled
from more2_jax.tracking.objects import accumulated_points, all_normals, place_of
from more2_jax.tracking.partly_shown import coming_along
from more2_jax.types import Instance, Observation, Repair, SceneObject

Shown = tuple[NearClouds, NearClouds]  # all that the scene and that a scan show, each in its own frame

# Chosen on rooms of regime `real`, docs/developing/notebook/mask_repair.md.
NEAR = 0.08  # shares of the object's radius: what lies so near its points lies on it
NEAR_M = 0.03  # and at least so near: what fusion and drift leave of a surface
LEAST_ON = 0.6  # share of a part that must lie on the whole
WORST_MISFIT = 0.5  # of the pose by which parts are laid onto the whole,
ON_AT_REST = 0.9  # if not so much of the part that was found lies on the whole where nothing moved


class Part(NamedTuple):
    """What a part was found to be part of."""

    whole: int  # row among those found
    on: float  # share of the part that lies on it; 0 where the pose is in doubt
    sure: float  # that share, or how surely the part came along (`coming_along`)


Parts = dict[int, Part]  # by rows of the parts


@dataclass(frozen=True, kw_only=True)
class Mended:
    """Instances and objects with what was split joined. Rows stay where they are; those in the sets are parts."""

    instances: list[Instance]
    objects: list[SceneObject]
    instance_parts: frozenset[int] = frozenset()
    object_parts: frozenset[int] = frozenset()
    repairs: tuple[Repair, ...] = ()

    def left_over(self, found: Sequence[tuple[int, int]]) -> tuple[list[int], list[int]]:
        """Rows of the objects and of the instances that were neither found nor are parts of others."""
        objects, instances = ({pair[side] for pair in found} for side in (0, 1))
        missing = set(range(len(self.objects))) - objects - self.object_parts
        return sorted(missing), sorted(set(range(len(self.instances))) - instances - self.instance_parts)

    def whole(self, objects: Sequence[SceneObject]) -> list[SceneObject]:
        """The objects less those that are parts of others."""
        return [o for row, o in enumerate(objects) if row not in self.object_parts]


def mend_splits(
    objects: Sequence[SceneObject],
    instances: Sequence[Instance],
    found: Sequence[tuple[int, int]],
    seen: Sequence[Observation],
    shown: Shown | None = None,
) -> Mended:
    """Joins the parts of one object: those in this scan, and those in the scan before.

    `found` names objects and instances by rows, `seen` says where each instance lies on its object. `shown`: all that
    the scene (its frame) and the scan show, z up; without it parts must lie on the whole.
    """
    mended, known, repairs = list(instances), list(objects), list[Repair]()
    before, after = shown or (None, None)
    now = parts_in_scan(objects, instances, found, seen, before)
    then = parts_known(objects, instances, found, seen, after)
    for n, (k, i) in enumerate(found):
        rows = [row for row, part in now.items() if part.whole == n]
        if rows:
            mended[i] = joined(instances[i], [instances[row] for row in rows])
            ids = tuple(instances[row].id for row in (i, *rows))
            share = min(now[row].on for row in rows)
            repairs.append(Repair(object=objects[k].id, instances=ids, share=share))
        for row in (row for row, part in then.items() if part.whole == n):
            known[k] = absorbed(known[k], objects[row])
            repairs.append(Repair(object=objects[k].id, absorbed=(objects[row].id,), share=then[row].on))
    return Mended(
        instances=mended,
        objects=known,
        instance_parts=frozenset(now),
        object_parts=frozenset(then),
        repairs=tuple(repairs),
    )


def parts_in_scan(
    objects: Sequence[SceneObject],
    instances: Sequence[Instance],
    found: Sequence[tuple[int, int]],
    seen: Sequence[Observation],
    before: NearClouds | None = None,
) -> Parts:
    """Instances left over that are parts of objects found by another one. `before`: what the scene shows."""
    left = sorted(set(range(len(instances))) - {i for _, i in found})
    balls = Balls.around([instances[i].points for i in left])
    parts: Parts = {}
    for n, ((k, own), pose) in enumerate(zip(found, seen, strict=True)):
        whole, T_scene_ref = accumulated_points(objects[k]), place_of(objects[k].observations[-1])
        trusted = laid_by(objects[k], whole, instances[own], pose)
        if trusted is None and not pose.converged:
            continue
        T_ref_scan = pose.T_ref_scan if trusted is None else trusted
        for i in (left[r] for r in balls.reach(whole, T_ref_scan)):
            points = instances[i].points
            on = 0.0 if trusted is None else share_on(whole, apply_pose(T_ref_scan, points))
            T = T_scene_ref @ T_ref_scan, at_rest(pose)
            sure = on if on >= LEAST_ON else coming_along(on, instances[own].points, points, *T, before)
            if sure is not None and (i not in parts or (on, sure) > parts[i][1:]):
                parts[i] = Part(n, on, sure)
    return parts


def parts_known(
    objects: Sequence[SceneObject],
    instances: Sequence[Instance],
    found: Sequence[tuple[int, int]],
    seen: Sequence[Observation],
    after: NearClouds | None = None,
) -> Parts:
    """Objects not found that are parts of one that was, now seen whole. `after`: what the scan shows.

    Only those that were seen when the other was, and once: two parts of one mask.
    """
    left = sorted(set(range(len(objects))) - {k for k, _ in found})
    balls = Balls.around([there(objects[q]) for q in left])
    parts: Parts = {}
    for n, ((k, i), pose) in enumerate(zip(found, seen, strict=True)):
        last = objects[k].observations[-1]
        trusted = laid_by(objects[k], accumulated_points(objects[k]), instances[i], pose)
        if trusted is None and not pose.converged:
            continue
        T_scene_scan = place_of(last) @ (pose.T_ref_scan if trusted is None else trusted)
        whole = apply_pose(T_scene_scan, instances[i].points)
        own = apply_pose(place_of(last), objects[k].points[objects[k].point_scan == last.scan])
        near = (left[r] for r in balls.reach(whole))
        for q in (q for q in near if [s.scan for s in objects[q].observations] == [last.scan]):
            points, rest = there(objects[q]), at_rest(pose)
            on = 0.0 if trusted is None else share_on(whole, points)
            T = np.linalg.inv(T_scene_scan), None if rest is None else np.linalg.inv(rest)
            sure = on if on >= LEAST_ON else coming_along(on, own, points, *T, after)
            if sure is not None and (q not in parts or (on, sure) > parts[q][1:]):
                parts[q] = Part(n, on, sure)
    return parts


def at_rest(pose: Observation) -> Pose | None:
    """T_scene_scan if nothing moved; None where the frame of the scan is not known."""
    return None if pose.frame.unknown else pose.frame.T_scene_scan


def there(o: SceneObject) -> Points:
    """An object where it was seen first, in the scene's frame."""
    return apply_pose(place_of(o.observations[0]), o.points)


@dataclass(frozen=True, kw_only=True)
class Balls:
    """Balls that hold clouds: most clouds of a building are told by them to lie nowhere near another."""

    center: Points
    radius_m: Float[np.ndarray, " n"]

    @classmethod
    def around(cls, clouds: Sequence[Points]) -> Balls:
        """One about each cloud."""
        center = np.array([c.mean(axis=0) for c in clouds]).reshape(-1, 3)
        radius = [np.linalg.norm(c - middle, axis=1).max() for c, middle in zip(clouds, center, strict=True)]
        return cls(center=center, radius_m=np.array(radius))

    def reach(self, whole: Points, T_whole_clouds: Pose | None = None) -> list[int]:
        """Which of the clouds may have points on a whole: their balls come so near the box about it."""
        center = self.center if T_whole_clouds is None else apply_pose(T_whole_clouds, self.center)
        beyond = np.maximum(np.maximum(whole.min(axis=0) - center, center - whole.max(axis=0)), 0.0)
        return np.flatnonzero(np.linalg.norm(beyond, axis=1) <= self.radius_m + reach_m(whole)).tolist()


def laid_by(o: SceneObject, whole: Points, instance: Instance, pose: Observation) -> Pose | None:
    """T_ref_scan that may say what lies on an object, of which all points known are given; None of none.

    The pose found of an instance. A part fits a whole badly however right its pose is: if it lies on the object where
    nothing moved, it stayed there.
    """
    if pose.converged and pose.misfit <= WORST_MISFIT:
        return pose.T_ref_scan
    if pose.frame.unknown:
        return None
    at_rest: Pose = np.linalg.inv(place_of(o.observations[-1])) @ pose.frame.T_scene_scan
    on = share_on(whole, apply_pose(at_rest, instance.points))
    return at_rest if on >= ON_AT_REST else None


def share_on(whole: Points, part: Points) -> float:
    """Share of a part's points on the surface of a whole, both in one frame."""
    distance, _ = KDTree(whole).query(part, distance_upper_bound=reach_m(whole))
    return float(np.isfinite(distance).mean())


def reach_m(whole: Points) -> float:
    """So near its points lies what lies on a cloud."""
    return max(NEAR * rms_radius(whole), NEAR_M)


def joined(first: Instance, others: Sequence[Instance]) -> Instance:
    """Several instances of a scan as one, with the first one's id; what not all of them have is lost."""
    every = [first, *others]

    def together(parts: list[np.ndarray | None]) -> np.ndarray | None:
        known = [p for p in parts if p is not None]
        return np.concatenate(known) if len(known) == len(parts) else None

    return dataclasses.replace(
        first,
        points=np.concatenate([i.points for i in every]),
        colors=together([i.colors for i in every]),
        normals=together([i.normals for i in every]),
    )


def absorbed(whole: SceneObject, part: SceneObject) -> SceneObject:
    """The object with what was seen of a part of it, at the place where both stood."""
    last, own = whole.observations[-1], part.observations[0]
    T_whole_part: Pose = np.linalg.inv(place_of(last)) @ place_of(own)
    return dataclasses.replace(
        whole,
        points=np.concatenate([whole.points, apply_pose(T_whole_part, part.points)]),
        point_scan=np.concatenate([whole.point_scan, part.point_scan]),
        normals=all_normals(whole, part, T_whole_part),
        color=pooled(whole.color, part.color),
        mesh=None,
    )
