"""Registration of matched pairs (paper §3.3): starts, coarse ICP, descent on SE(3), ICP; one pair, vmapped.

All poses here are `T_target_source` between *local* frames (points relative to each cloud's origin).
"""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from more2_jax.config import RegistrationConfig
from more2_jax.geometry.points import (
    cloud_radius,
    sample,
)
from more2_jax.geometry.transform import scale_embedding, scale_sight
from more2_jax.network.prior import Prior, check_embedding
from more2_jax.registration.descent import choose, keep_best, refine, with_stayed
from more2_jax.registration.starting_poses import Pair, candidate_poses
from more2_jax.registration.surface import register_surfaces
from more2_jax.types import Embedding, PointCloud, Registration, Sight


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
        return in_meters(register_surfaces(prior, starts, pair, config, upright), radius)
    starts = keep_best(starts, pair, config)
    refined = jax.vmap(lambda T: refine(prior, T, pair, config))(starts)
    if config.identity_start:
        refined = with_stayed(prior, refined, pair, config)
    return in_meters(choose(refined, config), radius)


def in_meters(result: Registration, radius: Float[Array, ""]) -> Registration:
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
