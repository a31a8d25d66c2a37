"""Joint optimization of accumulated objects (paper §3.5): one padded batch of all, and back."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jaxlie
import numpy as np

from more2_jax.config import SceneConfig
from more2_jax.geometry.observations import own_normals, own_points, with_poses
from more2_jax.geometry.padding import bucket
from more2_jax.geometry.poses import local_poses, world_poses
from more2_jax.network.embedding_batch import (
    padded,
    stack,
    unstack,
)
from more2_jax.network.prior import Prior, encode
from more2_jax.refinement.joint import Observations, fit_jointly
from more2_jax.registration.pair_batch import about
from more2_jax.types import AccumulatedObject


def fit_objects(
    prior: Prior, objects: Sequence[AccumulatedObject], config: SceneConfig
) -> list[AccumulatedObject]:
    """Optimizes code and poses of objects over all their observations, in one call."""
    if not objects:
        return []
    seen, origins = padded_observations(prior, objects, config)
    fit = jax.device_get(fit_jointly(prior, seen, config.joint))
    result = []
    for n, (o, embedding) in enumerate(zip(objects, unstack(fit.embedding, len(objects)), strict=True)):
        local = [jax.tree.map(lambda x, n=n, j=j: x[n, j], fit.T_ref_obs) for j in range(len(o.poses))]
        poses = [world_poses(T, origins[n, 0], origins[n, j]) for j, T in enumerate(local)]
        own = dataclasses.replace(embedding, origin=origins[n, 0])
        result.append(dataclasses.replace(with_poses(o, poses), embedding=own))
    return result


def padded_observations(
    prior: Prior, objects: Sequence[AccumulatedObject], config: SceneConfig
) -> tuple[Observations, np.ndarray]:
    """Every observation as one batch (objects, observations, …), and their float64 origins.

    Rows that are padding repeat an object's first observation, or the first object.
    """
    most = bucket(max(len(o.poses) for o in objects), 2)
    together, _ = stack([o.embedding for o in objects])
    rows = [*objects, *[objects[0]] * (len(together.scale) - len(objects))]
    clouds = [[own_points(o, j) for j in range(len(o.poses))] for o in rows]
    normals = [[own_normals(o, j) for j in range(len(o.poses))] for o in rows]
    # The j-th observations of all objects are one batch: as large as a scan's instances, whose program encodes it.
    batches = [
        padded(
            [row[j] if j < len(row) else row[0] for row in clouds],
            normals=[row[j] if j < len(row) else row[0] for row in normals],
        )
        for j in range(most)
    ]
    codes = [jax.device_get(encode(prior, batch)) for batch in batches]
    origins = np.stack([np.asarray(batch.origin) for batch in batches], axis=1)
    poses = np.tile([1.0, 0, 0, 0, 0, 0, 0], (len(rows), most, 1))
    for n, o in enumerate(objects):
        for j, T_ref_scan in enumerate(o.poses):
            poses[n, j] = local_poses(T_ref_scan, origins[n, 0], origins[n, j]).wxyz_xyz
    times_seen = np.array([len(o.poses) for o in objects] + [1] * (len(rows) - len(objects)))

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
