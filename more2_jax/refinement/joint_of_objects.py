"""Joint optimization of a scene's objects (paper §3.5): records to one padded batch, and back."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jaxlie
import numpy as np

from more2_jax.config import SceneConfig
from more2_jax.geometry.padding import bucket
from more2_jax.geometry.poses import Pose, apply_pose, local_poses, world_poses
from more2_jax.network.embedding_batch import (
    embed,
    padded,
    stack,
    unstack,
)
from more2_jax.network.prior import Prior, encode
from more2_jax.refinement.joint import Observations, fit_jointly
from more2_jax.registration.pair_batch import about
from more2_jax.tracking.objects import accumulated, accumulated_points, points_of
from more2_jax.types import SceneObject


def embed_accumulated(
    prior: Prior, objects: Sequence[SceneObject], chosen: Sequence[int]
) -> list[SceneObject]:
    """Encodes the accumulated clouds of the `chosen` objects; the others stay as they are."""
    result = list(objects)
    if chosen:
        for k, embedding in zip(
            chosen, embed(prior, [accumulated_points(objects[k]) for k in chosen]), strict=True
        ):
            result[k] = dataclasses.replace(objects[k], embedding=embedding)
    return result


def fit_objects(
    prior: Prior, objects: Sequence[SceneObject], chosen: Sequence[int], config: SceneConfig
) -> list[SceneObject]:
    """Optimizes code and poses of the `chosen` objects over all their observations, in one call."""
    result = list(objects)
    if not chosen:
        return result
    seen, origins = padded_observations(prior, [objects[k] for k in chosen], config)
    fit = jax.device_get(fit_jointly(prior, seen, config.joint))
    embeddings = unstack(fit.embedding, len(chosen))
    for n, k in enumerate(chosen):
        local = [
            jax.tree.map(lambda x, n=n, j=j: x[n, j], fit.T_ref_obs)
            for j in range(len(accumulated(objects[k])))
        ]
        poses = [world_poses(T, origins[n, 0], origins[n, j]) for j, T in enumerate(local)]
        embedding = dataclasses.replace(embeddings[n], origin=origins[n, 0])
        result[k] = dataclasses.replace(with_poses(objects[k], poses), embedding=embedding)
    return result


def padded_observations(
    prior: Prior, objects: Sequence[SceneObject], config: SceneConfig
) -> tuple[Observations, np.ndarray]:
    """Every accumulated observation as one batch (objects, observations, …), and their float64 origins.

    Rows that are padding repeat an object's first observation, or the first object.
    """
    most = bucket(max(len(accumulated(o)) for o in objects), 2)
    together, _ = stack([o.embedding for o in objects])
    rows = [*objects, *[objects[0]] * (len(together.scale) - len(objects))]
    clouds = [[points_of(o, seen) for seen in accumulated(o)] for o in rows]
    # The j-th observations of all objects are one batch: as large as a scan's instances, whose program encodes it.
    batches = [padded([row[j] if j < len(row) else row[0] for row in clouds]) for j in range(most)]
    codes = [jax.device_get(encode(prior, batch)) for batch in batches]
    origins = np.stack([np.asarray(batch.origin) for batch in batches], axis=1)
    poses = np.tile([1.0, 0, 0, 0, 0, 0, 0], (len(rows), most, 1))
    for n, o in enumerate(objects):
        for j, seen in enumerate(accumulated(o)):
            poses[n, j] = local_poses(seen.T_ref_scan, origins[n, 0], origins[n, j]).wxyz_xyz
    times_seen = np.array([len(accumulated(o)) for o in objects] + [1] * (len(rows) - len(objects)))

    def side_by_side(*columns: Any) -> Any:
        return jax.tree.map(lambda *x: np.stack(x, axis=1), *columns)

    return Observations(
        points=side_by_side(*[np.asarray(batch.points) for batch in batches]),
        mask=side_by_side(*[np.asarray(batch.mask) for batch in batches]),
        real=np.arange(most) < times_seen[:, None],  # type: ignore[arg-type]
        codes=dataclasses.replace(side_by_side(*codes), origin=None),
        T_ref_obs=jaxlie.SE3(poses.astype(np.float32)),  # type: ignore[arg-type]
        accumulated=about(together, origins[:, 0]),
    ), origins


def with_poses(o: SceneObject, poses: Sequence[Pose]) -> SceneObject:
    """The object with other poses of its accumulated observations, one each; its cloud follows."""
    points, posed = o.points.copy(), iter(poses)
    observations = []
    for seen in o.observations:
        T = next(posed) if seen.accumulated else seen.T_ref_scan
        if seen.accumulated:
            points[o.point_scan == seen.scan] = apply_pose(T, points_of(o, seen))
        observations.append(dataclasses.replace(seen, T_ref_scan=T))
    return dataclasses.replace(o, points=points, observations=tuple(observations))
