"""Registration of a batch of matched pairs (paper §3.3), by the method that its settings name.

Poses are `T_target_source` between local frames (points relative to each object's origin); `PairBatch.to_world` makes
them poses between the scans' own frames.
"""

from __future__ import annotations

import dataclasses
from functools import partial

import jax

from more2_jax.config import (
    DescentRegistration,
    FieldRegistration,
    MotionModel,
    RegistrationMethod,
    SurfaceRegistration,
)
from more2_jax.geometry.full_precision import full_precision
from more2_jax.network.prior import Prior, check_embedding
from more2_jax.network.row_map import chunked
from more2_jax.registration.descent import register_by_descent
from more2_jax.registration.field import register_by_field
from more2_jax.registration.older_calls import accepts_clouds
from more2_jax.registration.pair_batch import PairBatch
from more2_jax.registration.surface import register_by_surfaces
from more2_jax.types import Registration

# Settings are part of a program: `jax.jit(register)` takes them as they are.
for _settings in (DescentRegistration, SurfaceRegistration, FieldRegistration):
    jax.tree_util.register_static(_settings)

PAIRS_A_CALL = 8  # of descent and fields; `register_by_surfaces` has its own


@accepts_clouds
def register(
    prior: Prior, pairs: PairBatch, method: RegistrationMethod, motion: MotionModel = "free"
) -> Registration:
    """Registers row i of `pairs.source` onto row i of `pairs.target` (paper §3.3), all in compiled batches.

    Refines `pairs.candidates`, or searches for poses itself if there are none. `motion` "upright" allows shifts and
    turns about the vertical only. Works under `jax.jit` (of which `motion`, if it is given, is a static argument),
    `jax.vmap`, `jax.grad` and `jax.jvp`. Raises ValueError when the
    decoder cannot be asked about the codes: those of another encoder need a `SurfaceRegistration` whose
    `search.field_weight` is 0.
    """
    if not isinstance(method, SurfaceRegistration) or method.search.field_weight:
        check_embedding(prior, pairs.source.code, "register")
        check_embedding(prior, pairs.target.code, "register")
    if isinstance(method, SurfaceRegistration):
        return register_by_surfaces(prior, pairs.local(), method, motion)
    pairs = dataclasses.replace(pairs.local(), prepared=None, stands=None)
    if isinstance(method, DescentRegistration):
        return chunked(partial(_by_descent, prior, method=method), PAIRS_A_CALL, pairs)
    return chunked(partial(_by_field, prior, method=method, motion=motion), PAIRS_A_CALL, pairs)


@partial(jax.jit, static_argnames="method")
@full_precision
def _by_descent(prior: Prior, pairs: PairBatch, method: DescentRegistration) -> Registration:
    return register_by_descent(prior, pairs, method)


@partial(jax.jit, static_argnames=("method", "motion"))
@full_precision
def _by_field(prior: Prior, pairs: PairBatch, method: FieldRegistration, motion: MotionModel) -> Registration:
    return register_by_field(prior, pairs, method, motion)
