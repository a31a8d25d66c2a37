"""Calls as version 0.1 had them, for one release: each says what takes its place."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any

import jax
from jaxtyping import Float

from more2_jax.geometry.poses import Pose, world_poses
from more2_jax.registration.pair_batch import batch_of, pair_up
from more2_jax.types import Embedding, PointCloud, Registration, Sight


def accepts_clouds(register: Callable[..., Registration]) -> Callable[..., Registration]:
    """`register` that also takes `(prior, source, target, source_embedding, target_embedding, config, upright)`."""

    @functools.wraps(register)
    def either(prior: Any, pairs: Any, *rest: Any, **named: Any) -> Registration:
        if not isinstance(pairs, PointCloud):
            return register(prior, pairs, *rest, **named)
        warnings.warn(
            "register(prior, source, target, codes …) ends with version 0.3; use"
            " register(prior, pair_up(batch_of(source, code), batch_of(target, code)), method, motion)",
            DeprecationWarning,
            stacklevel=2,
        )
        return register(prior, *_as_pairs(pairs, *rest, **named))

    return either


def _as_pairs(
    source: PointCloud,
    target: PointCloud,
    source_embedding: Embedding,
    target_embedding: Embedding,
    config: Any,
    upright: bool = False,
    source_sight: Sight | None = None,
    target_sight: Sight | None = None,
) -> tuple[Any, Any, str]:
    one = batch_of(source, source_embedding, source_sight)
    other = batch_of(target, target_embedding, target_sight)
    return pair_up(one, other), config, "upright" if upright else "free"


def world_pose(T_target_source: Any, target_origin: Float[Any, "3"], source_origin: Float[Any, "3"]) -> Pose:
    """The pose between the scans' own frames from a local one; `PairBatch.to_world` takes its place."""
    warnings.warn(
        "world_pose ends with version 0.3; use PairBatch.to_world", DeprecationWarning, stacklevel=2
    )
    return world_poses(jax.device_get(T_target_source), target_origin, source_origin)
