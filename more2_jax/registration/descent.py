"""Registration by the paper's loss (§3.3): descent on SE(3) on the target's field and Chamfer distance, then ICP."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from more2_jax.config import DescentRegistration
from more2_jax.geometry.points import (
    Sampled,
    chamfer_distance,
    cloud_radius,
    icp,
    icp_step,
    sample,
    transformed,
    two_way_rms,
)
from more2_jax.geometry.se3_descent import adam, descend
from more2_jax.geometry.transform import rescale, transform
from more2_jax.network.prior import Prior, field_sdf, object_field
from more2_jax.registration.pair_batch import PairBatch
from more2_jax.registration.starting_poses import embedding_pose
from more2_jax.types import Embedding, Registration, pytree, quantity

STILL = 1e-2  # a last ICP step below this (radians, and shares of the radius) has settled


@pytree
class SampledPair:
    """One pair as descent compares it: farthest-point samples and codes, in local frames."""

    source: Sampled = quantity("record")
    target: Sampled = quantity("record")
    source_code: Embedding = quantity("record")
    target_code: Embedding = quantity("record")
    starts: jaxlie.SE3 = quantity("pose")  # (k,)


def register_by_descent(prior: Prior, pairs: PairBatch, settings: DescentRegistration) -> Registration:
    """All pairs of a batch; from the poses handed on by matching, or (paper §3.3) from Kabsch on the codes."""

    def one(pair: PairBatch) -> Registration:
        return register_pair(prior, sampled(pair, settings), settings)

    # On CPUs one by one: what a step compares of a pair, every point with every other, fills the caches.
    return jax.lax.map(one, pairs) if jax.default_backend() == "cpu" else jax.vmap(one)(pairs)


def sampled(pair: PairBatch, settings: DescentRegistration) -> SampledPair:
    """One pair (unbatched) with its samples and starts."""
    clouds = [sample(s.cloud.points, s.cloud.mask, settings.points) for s in (pair.source, pair.target)]
    starts = pair.candidates
    if starts is None:
        starts = jax.tree.map(lambda x: x[None], embedding_pose(pair.source.code, pair.target.code))
    return SampledPair(
        source=clouds[0],
        target=clouds[1],
        source_code=pair.source.code,
        target_code=pair.target.code,
        starts=starts,
    )


def register_pair(prior: Prior, pair: SampledPair, settings: DescentRegistration) -> Registration:
    """One pair: every start refined, the one with the lowest residual returned; differentiable.

    Works in units of the target's radius, so that one step size fits a cup and a wardrobe.
    """
    radius = cloud_radius(pair.target.points, pair.target.mask)
    pair = rescale(pair, 1 / radius)
    refined = jax.vmap(lambda T: refine(prior, T, pair, settings))(pair.starts)
    best = jnp.argmin(refined.rms_m)
    return rescale(jax.tree.map(lambda x: x[best], refined), radius)


def refine(prior: Prior, T: jaxlie.SE3, pair: SampledPair, settings: DescentRegistration) -> Registration:
    """Descent on `L_reg`, then ICP. The loss returned is that of the returned pose."""
    loss = registration_loss(prior, pair, settings)
    best, _ = descend(loss, T, adam(settings.learning_rate), settings.steps)
    final = icp(best, pair.source, pair.target, settings.trim, settings.icp_steps)
    last = icp_step(final, pair.source, pair.target, settings.trim)
    still = jnp.linalg.norm((last @ final.inverse()).log()) < STILL
    return scored(final, still, loss, pair, settings)


def registration_loss(
    prior: Prior, pair: SampledPair, settings: DescentRegistration
) -> Callable[[jaxlie.SE3], Array]:
    """`L_reg` of the paper as a function of the pose: |Ψ| of the moved source, and the Chamfer distance."""
    field, source, target = object_field(prior, pair.target_code), pair.source, pair.target
    asked, real = source.points[: settings.sdf_points], source.mask[: settings.sdf_points]

    def loss(T: jaxlie.SE3) -> Float[Array, ""]:
        distance = jnp.abs(field_sdf(prior, field, transformed(T, asked)))
        sdf = jnp.where(real, distance, 0.0).sum() / jnp.maximum(real.sum(), 1)
        moved = transformed(T, source.points)
        squared = settings.chamfer == "squared"
        chamfer = chamfer_distance(moved, source.mask, target.points, target.mask, squared)
        return settings.sdf_weight * sdf + settings.chamfer_weight * chamfer

    return loss


def scored(
    T: jaxlie.SE3,
    still: Bool[Array, ""],
    loss: Callable[[jaxlie.SE3], Array],
    pair: SampledPair,
    settings: DescentRegistration,
) -> Registration:
    """The record of a pose as it is."""
    residual = two_way_rms(transform(pair.source, T), pair.target, settings.trim)
    residual = jnp.where(jnp.isfinite(residual), residual, jnp.inf)
    converged = still & (residual < settings.converged_rms)
    return Registration(T_target_source=T, loss=loss(T), rms_m=residual, converged=converged)
