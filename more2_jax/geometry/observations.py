"""The observations of one accumulated object: what each saw alone, from where, and their poses replaced."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from more2_jax.geometry.free_space import spread
from more2_jax.geometry.poses import Points, Pose, apply_pose, turned
from more2_jax.types import AccumulatedObject


def own_points(o: AccumulatedObject, row: int) -> Points:
    """The points of one observation, in its scan's frame."""
    return apply_pose(np.linalg.inv(o.poses[row]), o.points[o.observation == row])


def own_normals(o: AccumulatedObject, row: int) -> Points | None:
    """The normals of those points, in its scan's frame; zeros where not known, None where the object has none."""
    if o.normals is None:
        return None
    return turned(np.linalg.inv(o.poses[row]), o.normals[o.observation == row])


def with_poses(o: AccumulatedObject, poses: Sequence[Pose]) -> AccumulatedObject:
    """The object with other poses of its observations, one each; points and normals follow, the embedding does not."""
    points, normals = o.points.copy(), None if o.normals is None else o.normals.copy()
    for row, T in enumerate(poses):
        points[o.observation == row] = apply_pose(T, own_points(o, row))
        if normals is not None:
            normals[o.observation == row] = turned(T, own_normals(o, row))
    return dataclasses.replace(o, points=points, normals=normals, poses=np.stack(poses))


def seen_from(o: AccumulatedObject) -> Float[np.ndarray, "n s 3"] | None:
    """Of every point, the places of the sensors that may have seen it, in the object's frame.

    `free_space.VIEWS` of an observation at most, those that lie farthest apart; NaN fills up. None where no sensor is
    known.
    """
    eyes = [apply_pose(T, places) for T, places in zip(o.poses, o.sensors, strict=True)]
    eyes = [places[spread(list(places), o.points.mean(axis=0))] for places in eyes]
    most = max(len(places) for places in eyes)
    if not most:
        return None
    of_observation = np.full((len(eyes), most, 3), np.nan)
    for row, places in enumerate(eyes):
        of_observation[row, : len(places)] = places
    return of_observation[o.observation]
