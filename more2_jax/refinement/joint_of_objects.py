"""Joint optimization of a scene's objects (paper §3.5): records to one padded batch, and back."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from more2_jax.config import SceneConfig
from more2_jax.geometry.padding import bucket
from more2_jax.geometry.poses import Pose, apply_pose, local_poses, world_poses
from more2_jax.network.embedding_batch import (
    SMALLEST_BATCH,
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
    seen, origins = gather(prior, [objects[k] for k in chosen], config)
    fit = jax.device_get(fit_jointly(prior, seen, config.joint))
    embeddings = unstack(fit.embedding, len(chosen))
    for n, k in enumerate(chosen):
        local = [
            jax.tree.map(lambda x, n=n, j=j: x[n, j], fit.T_ref_obs)
            for j in range(len(accumulated(objects[k])))
        ]
        poses = [world_poses(T, origins[n, 0], origins[n, j]) for j, T in enumerate(local)]
        embedding = dataclasses.replace(embeddings[n], origin=origins[n, 0])
        result[k] = dataclasses.replace(repose(objects[k], poses), embedding=embedding)
    return result


def gather(
    prior: Prior, objects: Sequence[SceneObject], config: SceneConfig
) -> tuple[Observations, np.ndarray]:
    """Every accumulated observation as one batch (objects, observations, …), and their float64 origins."""
    most = bucket(max(len(accumulated(o)) for o in objects), 2)
    count = bucket(len(objects), SMALLEST_BATCH)
    rows = [[points_of(o, seen) for seen in accumulated(o)] for o in objects]
    flat = [cloud for row in rows for cloud in [*row, *[row[0]] * (most - len(row))]]
    cloud = padded(flat, smallest=SMALLEST_BATCH * most)
    codes = encode(prior, cloud)
    origins = np.asarray(cloud.origin).reshape(-1, most, 3)[:count]
    together, _ = stack([o.embedding for o in objects])
    real, poses = np.zeros((count, most), bool), np.tile([1.0, 0, 0, 0, 0, 0, 0], (count, most, 1))
    real[:, 0] = True
    for n, o in enumerate(objects):
        for j, seen in enumerate(accumulated(o)):
            real[n, j], poses[n, j] = (
                True,
                local_poses(seen.T_ref_scan, origins[n, 0], origins[n, j]).wxyz_xyz,
            )
    split = lambda x: jnp.asarray(x).reshape(-1, most, *x.shape[1:])[:count]  # noqa: E731
    return Observations(
        points=split(cloud.points),
        mask=split(cloud.mask),
        real=jnp.asarray(real),
        codes=jax.tree.map(split, dataclasses.replace(codes, origin=None)),
        T_ref_obs=jaxlie.SE3(jnp.asarray(poses, jnp.float32)),
        accumulated=about(together, origins[:, 0]),
    ), origins


def repose(o: SceneObject, poses: Sequence[Pose]) -> SceneObject:
    """The object with other poses of its accumulated observations, one each; its cloud follows."""
    points, posed = o.points.copy(), iter(poses)
    observations = []
    for seen in o.observations:
        T = next(posed) if seen.accumulated else seen.T_ref_scan
        if seen.accumulated:
            points[o.point_scan == seen.scan] = apply_pose(T, points_of(o, seen))
        observations.append(dataclasses.replace(seen, T_ref_scan=T))
    return dataclasses.replace(o, points=points, observations=tuple(observations))
