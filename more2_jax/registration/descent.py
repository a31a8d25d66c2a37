"""Registration by descent (paper §3.3): SDF and chamfer loss minimized on SE(3) from the best starts, then ICP."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import jaxlie
from jax import Array
from jaxtyping import Bool, Float

from more2_jax.config import RegistrationConfig
from more2_jax.geometry.points import (
    Sampled,
    chamfer_distance,
    evenly,
    icp,
    icp_step,
    move,
    sample,
    transformed,
    two_way_rms,
)
from more2_jax.geometry.se3_descent import adam, descend
from more2_jax.network.prior import Prior, field_sdf, object_field
from more2_jax.registration.starting_poses import Pair
from more2_jax.registration.surface import lowest_apart
from more2_jax.types import Registration

# How much worse "it did not move" may fit and still be chosen (the offset in shares of the radius).
STAYED_RATIO, STAYED_OFFSET = 1.1, 0.001
STILL = 1e-2  # a last ICP step below this (radians, and shares of the radius) has settled


def keep_best(starts: jaxlie.SE3, pair: Pair, config: RegistrationConfig) -> jaxlie.SE3:
    """Moves every start by coarse ICP and keeps the `keep_starts` with the lowest residual."""
    if starts.wxyz_xyz.shape[0] <= config.keep_starts:
        return starts
    source, target = (
        sample(cloud.points, cloud.mask, config.coarse_points, dense=False)
        for cloud in (pair.source, pair.target)
    )
    moved = jax.vmap(lambda T: icp(T, source, target, config.trim, config.coarse_steps))(starts)
    misfit = jax.vmap(lambda T: residual(T, source, target, config.trim))(moved)
    best = lowest_apart(misfit, moved.rotation(), config.keep_starts)
    return jax.tree.map(lambda x: x[best], moved)


def residual(T: jaxlie.SE3, source: Sampled, target: Sampled, share: float) -> Float[Array, ""]:
    """Two-way trimmed residual of a pose; infinite if the pose is not finite."""
    rms = two_way_rms(move(T, source), target, share)
    return jnp.where(jnp.isfinite(rms), rms, jnp.inf)


def registration_loss(prior: Prior, pair: Pair, config: RegistrationConfig) -> Callable[[jaxlie.SE3], Array]:
    """`L_reg` of the paper as a function of the pose: |Ψ| of the moved source, and chamfer distance."""
    field, source, target = object_field(prior, pair.target_code), pair.source, pair.target
    few, few_mask = source.points[: config.sdf_points], source.mask[: config.sdf_points]

    def loss(T: jaxlie.SE3) -> Float[Array, ""]:
        distance = jnp.abs(field_sdf(prior, field, transformed(T, few)))
        sdf = jnp.where(few_mask, distance, 0.0).sum() / jnp.maximum(few_mask.sum(), 1)
        chamfer = chamfer_distance(transformed(T, source.points), source.mask, target.points, target.mask)
        return config.sdf_weight * sdf + config.chamfer_weight * chamfer

    return loss


def refine(prior: Prior, T: jaxlie.SE3, pair: Pair, config: RegistrationConfig) -> Registration:
    """Descent on `L_reg`, then ICP (paper §3.3). The loss returned is that of the returned pose."""
    loss = registration_loss(prior, pair, config)
    best, _ = descend(loss, T, adam(config.learning_rate), config.steps)
    source, target = (
        (evenly(c, 4) for c in (pair.source, pair.target)) if config.dense else (pair.source, pair.target)
    )
    final = icp(best, source, target, config.trim, config.icp_steps)
    last = icp_step(final, source, target, config.trim)
    still = jnp.linalg.norm((last @ final.inverse()).log()) < STILL
    return score_pose(final, still, loss, pair, config)


def score_pose(
    T: jaxlie.SE3,
    still: Bool[Array, ""],
    loss: Callable[[jaxlie.SE3], Array],
    pair: Pair,
    config: RegistrationConfig,
) -> Registration:
    """The record of a pose as it is."""
    source, target = (
        (evenly(c, 2) for c in (pair.source, pair.target)) if config.dense else (pair.source, pair.target)
    )
    misfit = residual(T, source, target, config.trim)
    converged = still & (misfit < config.converged_rms)
    return Registration(T_target_source=T, loss=loss(T), rms_m=misfit, converged=converged)


def with_stayed(prior: Prior, refined: Registration, pair: Pair, config: RegistrationConfig) -> Registration:
    """Adds "it did not move" to the poses, both refined and exactly as it is."""
    stayed = jaxlie.SE3.from_rotation_and_translation(jaxlie.SO3.identity(), pair.offset)
    exact = score_pose(stayed, jnp.array(True), registration_loss(prior, pair, config), pair, config)
    nearby = refine(prior, stayed, pair, config)
    return jax.tree.map(lambda many, *one: jnp.concatenate([many, jnp.stack(one)]), refined, nearby, exact)


def choose(refined: Registration, config: RegistrationConfig) -> Registration:
    """The pose with the lowest residual; with `identity_start`, "it did not move" (the last) if nearly as good.

    A symmetric object has many poses of equal residual, and a half-seen one a few of slightly less than the truth;
    that it stayed is the simplest explanation.
    """
    cost = refined.rms_m
    if config.identity_start:
        cost = cost.at[-1].set((cost[-1] - STAYED_OFFSET) / STAYED_RATIO)
    best = jnp.argmin(cost)
    return jax.tree.map(lambda x: x[best], refined)
