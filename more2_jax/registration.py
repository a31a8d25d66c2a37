"""Registration of matched pairs (paper §3.3): starts, coarse ICP, descent on SE(3), ICP; one pair, vmapped.

All poses here are `T_target_source` between *local* frames (points relative to each cloud's origin).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax import Array
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from more2_jax.config import RegistrationConfig
from more2_jax.descent import adam, descend
from more2_jax.geometry import (
    Sampled,
    chamfer_distance,
    cloud_radius,
    evenly,
    icp,
    icp_step,
    move,
    sample,
    transformed,
    two_way_rms,
)
from more2_jax.prior import Prior, check_embedding, field_sdf, object_field
from more2_jax.sight import scale_sight
from more2_jax.starts import Pair, candidate_poses
from more2_jax.surface_registration import lowest_apart, register_surfaces
from more2_jax.types import Embedding, PointCloud, Registration, Sight, scale_embedding

STILL = 1e-2  # a last ICP step below this (radians, and shares of the radius) has settled
# How much worse "it did not move" may fit and still be chosen (the offset in shares of the radius).
STAYED_RATIO, STAYED_OFFSET = 1.1, 0.001


def register(
    prior: Prior,
    source: PointCloud,
    target: PointCloud,
    source_embedding: Embedding,
    target_embedding: Embedding,
    config: RegistrationConfig,
    upright: bool = False,
    *,
    source_sight: Sight | None = None,
    target_sight: Sight | None = None,
) -> Registration:
    """Registers a batch of pairs in one call: row i of `source` onto row i of `target` (paper §3.3).

    Sights (`sight.padded_sights`, about the clouds' origins) say what sensors saw around each, where that is known.
    Returns local poses; `world_pose` makes them poses between the scans' frames. Raises ValueError when the
    batches differ in size, and when the decoder cannot be asked about the embeddings: those of another encoder need
    `config.refine` "surface" and a `field_weight` of 0.
    """
    sizes = [len(x) for x in (source.points, target.points, source_embedding.scale, target_embedding.scale)]
    if len(set(sizes)) != 1:
        raise ValueError(f"register got {sizes} sources, targets and their embeddings; needed equal numbers")
    if config.refine != "surface" or config.field_weight:
        check_embedding(prior, source_embedding, "register")
        check_embedding(prior, target_embedding, "register")
    # How far the source's local zero lies from the target's, when both scans share a frame.
    offset = jnp.asarray(np.asarray(source.origin) - np.asarray(target.origin), jnp.float32)
    zero = jnp.zeros_like(offset)
    codes = [dataclasses.replace(e, origin=zero) for e in (source_embedding, target_embedding)]
    clouds = (source.points, source.mask, target.points, target.mask)
    sights = (source_sight, target_sight)
    return _register_many(prior, *clouds, *codes, offset, sights, config, upright)


@partial(jax.jit, static_argnames=("config", "upright"))
def _register_many(
    prior: Prior,
    source: Float[Array, "b n 3"],
    source_mask: Bool[Array, "b n"],
    target: Float[Array, "b m 3"],
    target_mask: Bool[Array, "b m"],
    source_code: Embedding,
    target_code: Embedding,
    offset: Float[Array, "b 3"],
    sights: tuple[Sight | None, Sight | None],
    config: RegistrationConfig,
    upright: bool,
) -> Registration:
    """All pairs of a scene, or of many scenes, in one compiled program."""

    def one(
        s: Array,
        s_mask: Array,
        t: Array,
        t_mask: Array,
        a: Embedding,
        b: Embedding,
        shift: Array,
        sights: tuple[Sight | None, Sight | None],
    ) -> Registration:
        pair = Pair(
            source=sample(s, s_mask, config.points, config.dense),
            target=sample(t, t_mask, config.points, config.dense),
            source_code=a,
            target_code=b,
            offset=shift,
            source_sight=sights[0],
            target_sight=sights[1],
        )
        return register_one(prior, pair, config, upright)

    return jax.vmap(one)(source, source_mask, target, target_mask, source_code, target_code, offset, sights)


def register_one(prior: Prior, pair: Pair, config: RegistrationConfig, upright: bool) -> Registration:
    """One pair: candidate poses, the best few refined, the best of those returned; differentiable.

    Works in units of the target's radius, so that one step size fits a cup and a wardrobe.
    """
    radius = cloud_radius(pair.target.points, pair.target.mask)
    pair = rescale(pair, 1 / radius)
    starts = candidate_poses(pair, config, upright)
    if config.refine == "surface":
        return in_metres(register_surfaces(prior, starts, pair, config, upright), radius)
    starts = keep_best(starts, pair, config)
    refined = jax.vmap(lambda T: refine(prior, T, pair, config))(starts)
    if config.identity_start:
        refined = with_stayed(prior, refined, pair, config)
    return in_metres(choose(refined, config), radius)


def in_metres(result: Registration, radius: Float[Array, ""]) -> Registration:
    """A registration found in units of `radius`."""

    def scaled(T: jaxlie.SE3) -> jaxlie.SE3:
        return jaxlie.SE3.from_rotation_and_translation(T.rotation(), T.translation() * radius)

    unit = jnp.where(jnp.arange(6) < 3, radius, 1.0)
    return dataclasses.replace(
        result,
        T_target_source=scaled(result.T_target_source),
        rms_m=result.rms_m * radius,
        covariance=None if result.covariance is None else result.covariance * unit * unit[:, None],
        competing=None if result.competing is None else scaled(result.competing),
    )


def rescale(pair: Pair, factor: Float[Array, ""]) -> Pair:
    """The pair in other units of length."""
    source, target = (
        dataclasses.replace(cloud, points=cloud.points * factor, dense=cloud.dense * factor)
        for cloud in (pair.source, pair.target)
    )
    return Pair(
        source=source,
        target=target,
        source_code=scale_embedding(pair.source_code, factor),
        target_code=scale_embedding(pair.target_code, factor),
        offset=pair.offset * factor,
        source_sight=None if pair.source_sight is None else scale_sight(pair.source_sight, factor),
        target_sight=None if pair.target_sight is None else scale_sight(pair.target_sight, factor),
    )


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


def world_pose(
    T_target_source: jaxlie.SE3, target_origin: Float[np.ndarray, "3"], source_origin: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """The pose between the scans' own frames, float64 row-major, from a local one."""
    quaternion = np.asarray(T_target_source.rotation().wxyz, np.float64)
    rotation = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = (
        np.asarray(T_target_source.translation(), np.float64) + target_origin - rotation @ source_origin
    )
    return pose
