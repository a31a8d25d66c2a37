"""Registration of matched pairs (paper §3.3): starts, coarse ICP, descent on SE(3), ICP; one pair, vmapped.

All poses here are `T_target_source` between *local* frames (points relative to each cloud's origin).
"""

from __future__ import annotations

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
    chamfer_distance,
    cloud_radius,
    farthest_points,
    icp,
    icp_step,
    two_way_rms,
)
from more2_jax.prior import Prior, field_sdf, object_field
from more2_jax.starts import Pair, candidate_poses
from more2_jax.types import Embedding, PointCloud, Registration, scale_embedding

STILL = 1e-2  # a last ICP step below this (radians, and shares of the radius) has settled
EQUAL_RATIO, EQUAL_OFFSET = 1.05, 0.002  # residuals this close say the same (the offset in shares of the radius)


def register(
    prior: Prior,
    source: PointCloud,
    target: PointCloud,
    source_embedding: Embedding,
    target_embedding: Embedding,
    config: RegistrationConfig,
    upright: bool = False,
) -> Registration:
    """Registers a batch of pairs in one call: row i of `source` onto row i of `target` (paper §3.3).

    Returns local poses; `world_pose` makes them poses between the scans' frames. Raises ValueError when the
    batches differ in size.
    """
    sizes = [len(x) for x in (source.points, target.points, source_embedding.scale, target_embedding.scale)]
    if len(set(sizes)) != 1:
        raise ValueError(f"register got {sizes} sources, targets and their embeddings; needed equal numbers")
    # How far the source's local zero lies from the target's, when both scans share a frame.
    offset = jnp.asarray(np.asarray(source.origin) - np.asarray(target.origin), jnp.float32)
    pair = Pair(
        source=source.points,
        source_mask=source.mask,
        target=target.points,
        target_mask=target.mask,
        source_code=source_embedding.replace(origin=jnp.zeros_like(offset)),  # type: ignore[attr-defined]
        target_code=target_embedding.replace(origin=jnp.zeros_like(offset)),  # type: ignore[attr-defined]
        offset=offset,
    )
    return register_many(prior, pair, config, upright)


@partial(jax.jit, static_argnames=("config", "upright"))
def register_many(prior: Prior, pair: Pair, config: RegistrationConfig, upright: bool) -> Registration:
    """All pairs of a scene, or of many scenes, in one compiled program."""
    return jax.vmap(lambda one: register_one(prior, one, config, upright))(pair)


def register_one(prior: Prior, pair: Pair, config: RegistrationConfig, upright: bool) -> Registration:
    """One pair: candidate poses, the best few refined, the best of those returned; differentiable.

    Works in units of the target's radius, so that one step size fits a cup and a wardrobe.
    """
    pair = thin(pair, config.points)
    radius = cloud_radius(pair.target, pair.target_mask)
    pair = rescale(pair, 1 / radius)
    starts = keep_best(candidate_poses(pair, config, upright), pair, config)
    refined = jax.vmap(lambda T: refine(prior, T, pair, config))(starts)
    if config.identity_start:
        refined = with_stayed(prior, refined, pair, config)
    best = choose(refined, pair, config)
    T = best.T_target_source
    T = jaxlie.SE3.from_rotation_and_translation(T.rotation(), T.translation() * radius)
    return best.replace(T_target_source=T, rms_m=best.rms_m * radius)  # type: ignore[attr-defined]


def thin(pair: Pair, points: int) -> Pair:
    """Both clouds in farthest-point order, at most `points` each."""
    source, source_mask = farthest_points(pair.source, pair.source_mask, points)
    target, target_mask = farthest_points(pair.target, pair.target_mask, points)
    return pair.replace(source=source, source_mask=source_mask, target=target, target_mask=target_mask)  # type: ignore[attr-defined]


def rescale(pair: Pair, factor: Float[Array, ""]) -> Pair:
    """The pair in other units of length."""
    return pair.replace(  # type: ignore[attr-defined]
        source=pair.source * factor,
        target=pair.target * factor,
        source_code=scale_embedding(pair.source_code, factor),
        target_code=scale_embedding(pair.target_code, factor),
        offset=pair.offset * factor,
    )


def keep_best(starts: jaxlie.SE3, pair: Pair, config: RegistrationConfig) -> jaxlie.SE3:
    """Moves every start by coarse ICP and keeps the `keep_starts` with the lowest residual."""
    if starts.wxyz_xyz.shape[0] <= config.keep_starts:
        return starts
    coarse = thin(pair, config.coarse_points)
    clouds = (coarse.source, coarse.source_mask, coarse.target, coarse.target_mask)
    moved = jax.vmap(lambda T: icp(T, *clouds, config.trim, config.coarse_steps))(starts)
    misfit = jax.vmap(lambda T: residual(T, coarse, config.trim))(moved)
    _, best = jax.lax.top_k(-misfit, config.keep_starts)
    return jax.tree.map(lambda x: x[best], moved)


def residual(T: jaxlie.SE3, pair: Pair, share: float) -> Float[Array, ""]:
    """Two-way trimmed residual of a pose; infinite if the pose is not finite."""
    rms = two_way_rms(T @ pair.source, pair.source_mask, pair.target, pair.target_mask, share)
    return jnp.where(jnp.isfinite(rms), rms, jnp.inf)


def registration_loss(prior: Prior, pair: Pair, config: RegistrationConfig) -> Callable[[jaxlie.SE3], Array]:
    """`L_reg` of the paper as a function of the pose: |Ψ| of the moved source, and chamfer distance."""
    field = object_field(prior, pair.target_code)

    def loss(T: jaxlie.SE3) -> Float[Array, ""]:
        moved = T @ pair.source
        distance = jnp.abs(field_sdf(prior, field, moved))
        sdf = jnp.where(pair.source_mask, distance, 0.0).sum() / jnp.maximum(pair.source_mask.sum(), 1)
        chamfer = chamfer_distance(moved, pair.source_mask, pair.target, pair.target_mask)
        return config.sdf_weight * sdf + config.chamfer_weight * chamfer

    return loss


def refine(prior: Prior, T: jaxlie.SE3, pair: Pair, config: RegistrationConfig) -> Registration:
    """Descent on `L_reg`, then ICP (paper §3.3). The loss returned is that of the returned pose."""
    loss = registration_loss(prior, pair, config)
    best, _ = descend(loss, T, adam(config.learning_rate), config.steps)
    clouds = (pair.source, pair.source_mask, pair.target, pair.target_mask)
    final = icp(best, *clouds, config.trim, config.icp_steps)
    last = icp_step(final, *clouds, config.trim)
    still = jnp.linalg.norm((last @ final.inverse()).log()) < STILL
    return score_pose(final, still, loss, pair, config)


def score_pose(
    T: jaxlie.SE3, still: Bool[Array, ""], loss: Callable[[jaxlie.SE3], Array], pair: Pair, config: RegistrationConfig
) -> Registration:
    """The record of a pose as it is."""
    misfit = residual(T, pair, config.trim)
    converged = still & (misfit < config.converged_rms)
    return Registration(T_target_source=T, loss=loss(T), rms_m=misfit, converged=converged)


def with_stayed(prior: Prior, refined: Registration, pair: Pair, config: RegistrationConfig) -> Registration:
    """Adds "it did not move" to the poses, both refined and exactly as it is."""
    stayed = jaxlie.SE3.from_rotation_and_translation(jaxlie.SO3.identity(), pair.offset)
    exact = score_pose(stayed, jnp.array(True), registration_loss(prior, pair, config), pair, config)
    nearby = refine(prior, stayed, pair, config)
    return jax.tree.map(lambda many, *one: jnp.concatenate([many, jnp.stack(one)]), refined, nearby, exact)


def choose(refined: Registration, pair: Pair, config: RegistrationConfig) -> Registration:
    """The pose with the lowest residual; with `identity_start`, the least motion among equals.

    A symmetric object has many poses of equal residual; that it stayed is the simplest of them.
    """
    cost = refined.rms_m
    if config.identity_start:
        equal = cost <= cost.min() * EQUAL_RATIO + EQUAL_OFFSET
        cost = jnp.where(equal, jax.vmap(lambda T: motion(T, pair))(refined.T_target_source), jnp.inf)
    best = jnp.argmin(cost)
    return jax.tree.map(lambda x: x[best], refined)


def motion(T_target_source: jaxlie.SE3, pair: Pair) -> Float[Array, ""]:
    """Root mean square displacement of the source in the room, if both scans share a frame."""
    displacement = T_target_source @ pair.source - (pair.source + pair.offset)
    squared = jnp.where(pair.source_mask, jnp.sum(displacement**2, axis=-1), 0.0)
    return jnp.sqrt(squared.sum() / jnp.maximum(pair.source_mask.sum(), 1))


def world_pose(
    T_target_source: jaxlie.SE3, target_origin: Float[np.ndarray, "3"], source_origin: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """The pose between the scans' own frames, float64 row-major, from a local one."""
    quaternion = np.asarray(T_target_source.rotation().wxyz, np.float64)
    rotation = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = np.asarray(T_target_source.translation(), np.float64) + target_origin - rotation @ source_origin
    return pose
