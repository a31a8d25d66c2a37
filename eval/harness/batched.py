"""The package's batched stages over many scenes: batches of one fixed shape, spread over all local devices."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TypeVar

import jax
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from more2_jax.config import MotionModel, RegistrationMethod
from more2_jax.geometry.padding import MAX_POINTS, pad_batch, pad_clouds
from more2_jax.geometry.poses import Points, Pose
from more2_jax.network.embedding_batch import unstack
from more2_jax.network.prior import Prior, encode
from more2_jax.registration.pair_batch import local_batch, pair_up
from more2_jax.registration.register_pairs import register
from more2_jax.types import Embedding, ObservedObject, PointCloud

Tree = TypeVar("Tree")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairToRegister:
    """One pair, each object in its scan's frame."""

    source: ObservedObject
    target: ObservedObject


def over_devices(tree: Tree, batch: int) -> Tree:
    """Arrays of a batch, split over the local devices along their first axis; as they are on a single device."""
    devices = jax.local_devices()
    if len(devices) == 1:
        return tree
    if batch % len(devices):
        raise ValueError(f"batch {batch} for {len(devices)} devices; needed a multiple")
    mesh = jax.make_mesh((len(devices),), ("batch",), axis_types=(AxisType.Auto,), devices=devices)
    return jax.device_put(tree, NamedSharding(mesh, PartitionSpec("batch")))


def padded_batch(
    clouds: Sequence[Points], batch: int, normals: Sequence[Points | None] | None = None
) -> PointCloud:
    """Clouds as one batch of the fixed shape (batch, `MAX_POINTS`, 3), spread over devices."""
    cloud = pad_batch(pad_clouds(clouds, MAX_POINTS, normals), batch)
    points, mask, known = over_devices((cloud.points, cloud.mask, cloud.normals), batch)
    return dataclasses.replace(cloud, points=points, mask=mask, normals=known)


def embed_all(
    prior: Prior, clouds: Sequence[Points], batch: int, normals: Sequence[Points | None] | None = None
) -> list[Embedding]:
    """One embedding a cloud, host arrays, in calls of `batch` clouds; `normals` as `pad_clouds` takes them."""
    found: list[Embedding] = []
    for start in range(0, len(clouds), batch):
        part = clouds[start : start + batch]
        known = None if normals is None else normals[start : start + batch]
        found += unstack(encode(prior, padded_batch(part, batch, known)), len(part))
    return found


def register_all(
    prior: Prior, pairs: Sequence[PairToRegister], method: RegistrationMethod, motion: MotionModel, batch: int
) -> list[Pose]:
    """`T_target_source` of every pair, between the scans' own frames, in calls of `batch` pairs."""
    found: list[Pose] = []
    for start in range(0, len(pairs), batch):
        part = pairs[start : start + batch]
        # `register` makes few shapes of any number of pairs; descent, one program a batch, is given one shape.
        ready = pair_up(
            local_batch([p.source for p in part], batch), local_batch([p.target for p in part], batch)
        )
        result = jax.device_get(register(prior, ready, method, motion))
        found += list(ready.to_world(result.T_target_source)[: len(part)])
    return found
