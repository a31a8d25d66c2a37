"""Scene records to accumulated objects for refinement and meshing, and what these answer back into records."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from more2_jax.geometry.open_below import most_seen_beneath
from more2_jax.geometry.poses import apply_pose
from more2_jax.network.embedding_batch import embed
from more2_jax.network.prior import Prior, anchor_levels
from more2_jax.tracking.objects import accumulated, accumulated_normals, accumulated_points, reference_pose
from more2_jax.types import AccumulatedObject, LivingScene, ScanRecord, SceneObject


def accumulated_object(o: SceneObject, scans: Sequence[ScanRecord]) -> AccumulatedObject:
    """The object with its accumulated observations alone. `scans`: of the scene, each at its index."""
    seen = accumulated(o)
    row = np.zeros(1 + max(s.scan for s in seen), int)
    row[[s.scan for s in seen]] = np.arange(len(seen))
    kept = np.isin(o.point_scan, [s.scan for s in seen])
    points, poses = accumulated_points(o), np.stack([s.T_ref_scan for s in seen])
    return AccumulatedObject(
        points=points,
        observation=row[o.point_scan[kept]],
        poses=poses,
        embedding=o.embedding,
        normals=accumulated_normals(o),
        sensors=tuple(scans[s.scan].sensors for s in seen),
        background=apply_pose(reference_pose(o), scans[o.reference_scan].background),
        seen_beneath=most_seen_beneath(points, list(poses), [scans[s.scan].background for s in seen]),
    )


def accumulated_objects(
    objects: Sequence[SceneObject], chosen: Sequence[int], scans: Sequence[ScanRecord]
) -> Iterator[AccumulatedObject]:
    """`accumulated_object` of the `chosen`, in their order."""
    return (accumulated_object(objects[k], scans) for k in chosen)


def with_refined(
    objects: Sequence[SceneObject], chosen: Sequence[int], refined: Sequence[AccumulatedObject]
) -> list[SceneObject]:
    """The objects with the poses, points and embeddings that the `chosen` have now; the others stay as they are."""
    result = list(objects)
    for k, new in zip(chosen, refined, strict=True):
        result[k] = refined_object(objects[k], new)
    return result


def refined_object(o: SceneObject, refined: AccumulatedObject) -> SceneObject:
    """The record with what refinement made of it; observations in doubt, and their points, stay."""
    seen, poses = accumulated(o), iter(refined.poses)
    rows = np.isin(o.point_scan, [s.scan for s in seen])
    points, normals = o.points.copy(), None if o.normals is None else o.normals.copy()
    points[rows] = refined.points
    if normals is not None and refined.normals is not None:
        normals[rows] = refined.normals
    observations = tuple(
        dataclasses.replace(s, T_ref_scan=next(poses)) if s.accumulated else s for s in o.observations
    )
    return dataclasses.replace(
        o, points=points, normals=normals, observations=observations, embedding=refined.embedding
    )


def readable(prior: Prior, scene: LivingScene) -> LivingScene:
    """The scene, objects encoded anew that weights with other look-ups have encoded, as in scenes stored long ago."""
    levels = anchor_levels(prior.config)
    older = [k for k, o in enumerate(scene.objects) if len(o.embedding.anchors) != levels]
    return dataclasses.replace(scene, objects=tuple(embed_accumulated(prior, scene.objects, older)))


def embed_accumulated(
    prior: Prior, objects: Sequence[SceneObject], chosen: Sequence[int]
) -> list[SceneObject]:
    """Encodes the accumulated clouds of the `chosen` objects; the others stay as they are."""
    result = list(objects)
    if chosen:
        clouds = [accumulated_points(objects[k]) for k in chosen]
        normals = [accumulated_normals(objects[k]) for k in chosen]
        for k, embedding in zip(chosen, embed(prior, clouds, normals), strict=True):
            result[k] = dataclasses.replace(objects[k], embedding=embedding)
    return result
