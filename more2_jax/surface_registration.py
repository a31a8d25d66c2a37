"""Registration of one pair by its surfaces: every start aligned, the best told by a truncated distance.

Beyond the paper (`RegistrationConfig.refine` "surface"): point-to-plane alignment both ways takes the place of the
descent on the field, and poses are compared by the share of both clouds that finds its like, not by a residual that
the unseen spoils.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
from jax import Array
from jaxtyping import Bool, Float

from more2_jax.alignment import Surface, align, align_step, correspondences, pose_covariance, surface
from more2_jax.config import RegistrationConfig
from more2_jax.geometry import FAR, Sampled, evenly, move, two_way_rms
from more2_jax.starts import Pair
from more2_jax.types import Registration

STILL = 1e-2  # a last step below this (radians, and shares of the radius) has settled
# How much worse "it did not move" may fit and still be chosen; so much worse, another pose still competes.
STAYED_RATIO, STAYED_OFFSET = 1.1, 0.01
POINT_SHARE = 0.4  # of the distance to the nearest point, in a misfit; the rest is that off its surface
TURNED_DEG = 15.0  # competing poses differ by more


def register_surfaces(
    starts: jaxlie.SE3, pair: Pair, config: RegistrationConfig, upright: bool
) -> Registration:
    """The best pose of all starts, its covariance, and the poses that explain the clouds as well.

    `pair` is in units of the target's radius, and so is the result. `loss` and `misfit` are the truncated distance.
    """
    source, target = (surface(thinned(c, config.surface_points)) for c in (pair.source, pair.target))
    stayed = jaxlie.SE3.from_rotation_and_translation(jaxlie.SO3.identity(), pair.offset)
    stayed = jax.tree.map(lambda x: x[None], stayed)
    if config.identity_start:
        starts = join(starts, stayed)
    reach = (config.first_reach, config.last_reach)
    poses = jax.vmap(lambda T: align(T, source, target, reach, config.surface_steps, upright))(starts)
    if config.identity_start:
        poses = join(poses, stayed)  # also exactly as it is
    misfits = jax.vmap(lambda T: misfit(T, source, target, config.truncation))(poses)
    best = choose(misfits, config.identity_start)
    T = polished(jax.tree.map(lambda x: x[best], poses), pair, misfits[best], config, upright)
    if config.identity_start:  # what stayed is exactly where it was
        T = jax.tree.map(lambda x, y: jnp.where(best == len(misfits) - 1, y[0], x), T, stayed)
    rms = two_way_rms(move(T, source.sampled), target.sampled, config.trim)
    last = align_step(T, source, target, jnp.asarray(config.last_reach), upright)
    still = jnp.linalg.norm((last @ T.inverse()).log()) < STILL
    rms = jnp.where(jnp.isfinite(rms), rms, jnp.inf)
    return Registration(
        T_target_source=T,
        loss=misfits[best],
        rms_m=rms,
        converged=still & (rms < config.converged_rms),
        misfit=misfits[best],
        covariance=pose_covariance(T, source, target, config.last_reach, upright),
        competing=poses,
        competes=competing(poses, misfits, best),
    )


def polished(
    T: jaxlie.SE3, pair: Pair, before: Float[Array, ""], config: RegistrationConfig, upright: bool
) -> jaxlie.SE3:
    """The pose aligned with more points and a short reach; as it was if that makes it fit worse."""
    source, target = (surface(thinned(c, config.polish_points)) for c in (pair.source, pair.target))
    reach = (config.last_reach, config.polish_reach)
    finer = align(T, source, target, reach, config.polish_steps, upright)
    better = misfit(finer, source, target, config.truncation) <= before * STAYED_RATIO + STAYED_OFFSET
    return jax.tree.map(lambda x, y: jnp.where(better, x, y), finer, T)


def join(a: jaxlie.SE3, b: jaxlie.SE3) -> jaxlie.SE3:
    """Both batches of poses."""
    return jax.tree.map(lambda x, y: jnp.concatenate([x, y]), a, b)


def thinned(cloud: Sampled, count: int) -> Sampled:
    """About `count` of the cloud's rows, sampled as densely as it was seen."""
    return evenly(cloud, max(1, len(cloud.dense) // count))


def misfit(T: jaxlie.SE3, source: Surface, target: Surface, truncation: float) -> Float[Array, ""]:
    """Mean truncated distance both ways, as a share of the truncation; 1 if the pose is not finite.

    Of a point near the other cloud it is mostly the distance off its surface: that to the nearest point has the
    spacing of points for a floor, under which details such as a handle disappear.
    """
    c = correspondences(T, source, target)
    gap, count = c.target - c.source, len(source.normals)
    off = sum(jnp.sum(gap * normal, axis=-1) ** 2 for normal in (c.source_normal, c.target_normal)) / 2
    near = (1 - POINT_SHARE) * off + POINT_SHARE * c.squared
    squared = jnp.where(c.squared < truncation**2, near, c.squared)
    share = jnp.minimum(jnp.sqrt(squared + 1e-12) / truncation, 1.0)
    real = c.squared < FAR
    ways = [(share[:count], real[:count]), (share[count:], real[count:])]
    mean = sum(jnp.where(r, s, 0.0).sum() / jnp.maximum(r.sum(), 1) for s, r in ways) / 2
    return jnp.where(jnp.isfinite(mean) & jnp.isfinite(T.wxyz_xyz).all(), mean, 1.0)


def choose(misfits: Float[Array, " k"], stayed_is_last: bool) -> Array:
    """The pose with the least misfit; "it did not move" (the last) if nearly as good: the simplest explanation."""
    if stayed_is_last:
        misfits = misfits.at[-1].set((misfits[-1] - STAYED_OFFSET) / STAYED_RATIO)
    return jnp.argmin(misfits)


def competing(poses: jaxlie.SE3, misfits: Float[Array, " k"], best: Array) -> Bool[Array, " k"]:
    """Which poses explain the clouds about as well as the best, yet turn the object otherwise: its symmetry."""
    q = poses.rotation().wxyz
    half = jnp.abs(q @ q[best])
    apart = half < jnp.cos(jnp.deg2rad(TURNED_DEG) / 2)
    return apart & (misfits <= misfits[best] * STAYED_RATIO + STAYED_OFFSET)
