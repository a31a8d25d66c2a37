"""The package's batched stages over many scenes: batches of one fixed shape, spread over all local devices."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from more2_jax.config import RegistrationConfig
from more2_jax.geometry.free_space import padded_sights
from more2_jax.geometry.padding import MAX_POINTS, pad_batch, pad_clouds
from more2_jax.geometry.poses import Points, Pose, world_pose
from more2_jax.network.embedding_batch import unstack, with_origin
from more2_jax.network.prior import Prior, encode
from more2_jax.registration.register import register
from more2_jax.types import Embedding, PointCloud, Sight

Tree = TypeVar("Tree")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairToRegister:
    """One pair; clouds and embeddings each in its scan's frame."""

    source: Points
    target: Points
    source_code: Embedding
    target_code: Embedding
    source_sight: Sight | None = None
    target_sight: Sight | None = None


def over_devices(tree: Tree, batch: int) -> Tree:
    """Arrays of a batch, split over the local devices along their first axis; as they are on a single device."""
    devices = jax.local_devices()
    if len(devices) == 1:
        return tree
    if batch % len(devices):
        raise ValueError(f"batch {batch} for {len(devices)} devices; needed a multiple")
    mesh = jax.make_mesh((len(devices),), ("batch",), axis_types=(AxisType.Auto,), devices=devices)
    return jax.device_put(tree, NamedSharding(mesh, PartitionSpec("batch")))


def padded_batch(clouds: Sequence[Points], batch: int) -> PointCloud:
    """Clouds as one batch of the fixed shape (batch, `MAX_POINTS`, 3), spread over devices."""
    cloud = pad_batch(pad_clouds(clouds, MAX_POINTS), batch)
    points, mask = over_devices((cloud.points, cloud.mask), batch)
    return dataclasses.replace(cloud, points=points, mask=mask)


def embed_all(prior: Prior, clouds: Sequence[Points], batch: int) -> list[Embedding]:
    """One embedding a cloud, host arrays, in calls of `batch` clouds."""
    found: list[Embedding] = []
    for start in range(0, len(clouds), batch):
        part = clouds[start : start + batch]
        found += unstack(encode(prior, padded_batch(part, batch)), len(part))
    return found


def register_all(
    prior: Prior, pairs: Sequence[PairToRegister], config: RegistrationConfig, upright: bool, batch: int
) -> list[Pose]:
    """`T_target_source` of every pair, between the scans' own frames, in calls of `batch` pairs."""
    found: list[Pose] = []
    for start in range(0, len(pairs), batch):
        part = pairs[start : start + batch]
        source, target = (padded_batch([getattr(p, k) for p in part], batch) for k in ("source", "target"))
        source_code, target_code = (
            with_origin(stacked([getattr(p, k) for p in part], batch), np.asarray(cloud.origin))
            for k, cloud in (("source_code", source), ("target_code", target))
        )
        sights = {
            f"{side}_sight": padded_sights(
                [getattr(p, f"{side}_sight") for p in part], np.asarray(cloud.origin)
            )
            for side, cloud in (("source", source), ("target", target))
        }
        over = over_devices(sights, batch)
        found_here = register(prior, source, target, source_code, target_code, config, upright, **over)
        result = jax.device_get(found_here)
        for n in range(len(part)):
            T = jax.tree.map(lambda x, n=n: jnp.asarray(x[n]), result.T_target_source)
            found.append(world_pose(T, np.asarray(target.origin)[n], np.asarray(source.origin)[n]))
    return found


def stacked(codes: Sequence[Embedding], batch: int) -> Embedding:
    """A batch of fixed size; the fillers repeat the first."""
    rows = [*codes, *[codes[0]] * (batch - len(codes))]
    return jax.tree.map(lambda *x: np.stack(x), *rows)
