"""Registration of one pair by its surfaces: every start aligned, the best told by a truncated distance.

Beyond the paper (`RegistrationConfig.refine` "surface"): point-to-plane alignment both ways takes the place of the
descent on the field, and poses are compared by the share of both clouds that finds its like, not by a residual that
the unseen spoils. What has no like in the other cloud may still lie on the surface that the prior completes it with:
poses that fit about as well are told apart by that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import jaxlie
from jax import Array
from jaxtyping import Bool, Float, Int

from more2_jax.config import RegistrationConfig
from more2_jax.geometry.free_space import looked_through
from more2_jax.geometry.point_to_plane import (
    Surface,
    align,
    align_step,
    coarsened,
    correspondences,
    pose_covariance,
    thinned,
    whole_surface,
)
from more2_jax.geometry.points import FAR, Sampled, move, transformed, two_way_rms
from more2_jax.network.prior import Prior, field_sdf, object_field
from more2_jax.registration.starting_poses import Pair
from more2_jax.types import Embedding, Registration, Sight

Way = Callable[[jaxlie.SE3], jaxlie.SE3]

STILL = 1e-2  # a last step below this (radians, and shares of the radius) has settled
# How much worse "it did not move" may fit and still be chosen; so much worse, another pose still competes.
STAYED_RATIO, STAYED_OFFSET = 1.1, 0.01
FINE = 0.25  # share of the truncation: the nearer one by which refined poses are told apart
POINT_SHARE = 0.4  # of the distance to the nearest point, in a misfit; the rest is that off its surface
TURNED_DEG = 15.0  # competing poses differ by more
APART_DEG = 25.0  # poses kept for refinement differ by at least this
OFF_FIELD = 0.1  # canonical units: farther than this from the other's completed surface is this far
ABOUT_AS_WELL = 0.2  # of misfit: poses that fit worse than the best by more are not the prior's to choose
CLEARLY = 0.05  # shares of the radius: a point so deep in free space counts in full
LIFTED = 0.1  # shares of the radius: an object lifted by this costs all of `lift_weight`


def register_surfaces(
    prior: Prior, starts: jaxlie.SE3, pair: Pair, config: RegistrationConfig, upright: bool
) -> Registration:
    """The best pose of all starts, its covariance, and the poses that explain the clouds as well.

    `pair` is in units of the target's radius, and so is the result. `loss` and `misfit` are the truncated distance.
    """
    whole = [whole_surface(c.dense, c.dense_mask) for c in (pair.source, pair.target)]
    coarse = [coarse_of(s, config) for s in whole]
    starts, _ = search(starts, coarse[0], coarse[1], pair, config, upright)
    source, target = (thinned(s, config.surface_points) for s in whole)
    stayed = jax.tree.map(lambda x: x[None], jaxlie.SE3.from_translation(pair.offset))
    if config.identity_start:
        starts = join(starts, stayed)
    reach = (config.first_reach, config.last_reach)
    truncations = (FINE * config.truncation, config.truncation)
    poses = jax.vmap(lambda T: align(T, source, target, reach, config.surface_steps, upright))(starts)
    if config.identity_start:
        poses = join(poses, stayed)  # also exactly as it is
    misfits = jax.vmap(lambda T: misfit(T, source, target, truncations))(poses)
    costs = misfits + lifted(poses, pair.offset, config, upright) + freed(poses, pair, source, target, config)
    doubt = prior_doubts(prior, poses, costs, pair, whole, config)
    best = choose(costs, config.identity_start, doubt)
    T = polished(jax.tree.map(lambda x: x[best], poses), whole, misfits[best], config, upright)
    if config.identity_start:  # what stayed is exactly where it was
        T = jax.tree.map(lambda x, y: jnp.where(best == len(misfits) - 1, y[0], x), T, stayed)
    rms = two_way_rms(move(T, source.sampled), target.sampled, config.trim)
    still = settled(T, source, target, config, upright)
    return Registration(
        T_target_source=T,
        loss=misfits[best],
        rms_m=jnp.where(jnp.isfinite(rms), rms, jnp.inf),
        converged=still & (rms < config.converged_rms),
        misfit=misfits[best],
        covariance=pose_covariance(T, source, target, config.last_reach, upright),
        competing=poses,
        competes=competing(poses, costs + doubt, best),
    )


def settled(
    T: jaxlie.SE3, source: Surface, target: Surface, config: RegistrationConfig, upright: bool
) -> Bool[Array, ""]:
    """Whether one more step hardly changes the pose."""
    last = align_step(T, source, target, jnp.asarray(config.last_reach), upright)
    return jnp.linalg.norm((last @ T.inverse()).log()) < STILL


def coarse_of(s: Surface, config: RegistrationConfig) -> Surface:
    """The surface as `search` takes it."""
    return coarsened(s, config.coarse_points, config.coarse_dense, config.cells)


def search(
    starts: jaxlie.SE3,
    source: Surface,
    target: Surface,
    pair: Pair,
    config: RegistrationConfig,
    upright: bool,
) -> tuple[jaxlie.SE3, Float[Array, " k"]]:
    """Aligns every start by coarse surfaces; the best `keep_starts` that lie apart, and their costs."""
    reach = (config.search_reach, config.first_reach)
    moved = jax.vmap(lambda T: align(T, source, target, reach, config.coarse_steps, upright))(starts)
    cost = jax.vmap(lambda T: misfit(T, source, target, (config.truncation,)))(moved)
    cost = cost + lifted(moved, pair.offset, config, upright) + freed(moved, pair, source, target, config)
    best = lowest_apart(cost, moved.rotation(), min(config.keep_starts, len(cost)))
    return jax.tree.map(lambda x: x[best], moved), cost[best]


def lifted(
    poses: jaxlie.SE3, offset: Float[Array, "3"], config: RegistrationConfig, upright: bool
) -> Float[Array, " k"]:
    """What it costs to be at another height than before: upright objects of scans in one frame stand on the floor."""
    height = jnp.abs(poses.translation()[:, 2] - offset[2])
    weight = config.lift_weight if upright and config.identity_start else 0.0
    return weight * jnp.minimum(height / LIFTED, 1.0)


def freed(
    poses: jaxlie.SE3, pair: Pair, source: Surface, target: Surface, config: RegistrationConfig
) -> Float[Array, " k"]:
    """What it costs to lie where the other cloud's sensors looked through: of both clouds, the share that does."""
    sights = ((pair.target_sight, source, lambda T: T), (pair.source_sight, target, lambda T: T.inverse()))
    cost = jnp.zeros(poses.wxyz_xyz.shape[0])
    for sight, surface, way in sights if config.free_weight else ():
        if sight is None:
            continue
        cloud = surface.sampled

        def share(T: jaxlie.SE3, sight: Sight = sight, cloud: Sampled = cloud, way: Way = way) -> Array:
            return looked_through(sight, transformed(way(T), cloud.points), cloud.mask, CLEARLY)

        cost += config.free_weight / 2 * jax.vmap(share)(poses)
    return cost


def prior_doubts(
    prior: Prior,
    poses: jaxlie.SE3,
    costs: Float[Array, " k"],
    pair: Pair,
    whole: Sequence[Surface],
    config: RegistrationConfig,
) -> Float[Array, " k"]:
    """`doubts` of both ways' mean; none where the prior is not asked."""
    if not config.field_weight:
        return jnp.zeros_like(costs)
    few = [thinned(s, config.sdf_points) for s in whole]
    return doubts(costs, off_fields(prior, poses, pair, few).mean(axis=1), config.field_weight)


def doubts(costs: Float[Array, " k"], off: Float[Array, " k"], weight: float) -> Float[Array, " k"]:
    """What the prior adds to the costs of poses: it tells those apart that fit about as well, and has no say beyond."""
    return weight * jnp.where(costs <= costs.min() + ABOUT_AS_WELL, off, 1.0)


def off_fields(
    prior: Prior, poses: jaxlie.SE3, pair: Pair, surfaces: Sequence[Surface]
) -> Float[Array, "k 2"]:
    """Of every pose, how far the source's sample lies from the surface that the prior gives the target, and the
    target's from that of the source: 0 on it, 1 `OFF_FIELD` away. A pose that is not finite has 1."""
    source, target = (s.sampled for s in surfaces)

    def both_ways(T: jaxlie.SE3) -> Float[Array, "2"]:
        there = off_field(prior, T, source, pair.target_code)
        return jnp.stack([there, off_field(prior, T.inverse(), target, pair.source_code)])

    return jax.vmap(both_ways)(poses)


def off_field(prior: Prior, T: jaxlie.SE3, cloud: Sampled, code: Embedding) -> Float[Array, ""]:
    """How far a moved sample lies off the completed surface of `code`, as in `off_fields`."""
    distance = jnp.abs(field_sdf(prior, object_field(prior, code), transformed(T, cloud.points)))
    share = jnp.where(cloud.mask, jnp.minimum(distance / OFF_FIELD, 1.0), 0.0)
    mean = share.sum() / jnp.maximum(cloud.mask.sum(), 1)
    return jnp.where(jnp.isfinite(mean), mean, 1.0)


def lowest_apart(cost: Float[Array, " n"], rotation: jaxlie.SO3, count: int) -> Int[Array, " count"]:
    """Indices of the `count` lowest costs whose rotations are at least `APART_DEG` from one another.

    Many starts end in the same place; without this the few kept would be copies of one pose.
    """

    def body(cost: Array, _: None) -> tuple[Array, Array]:
        best = jnp.argmin(cost)
        # ⟨q, q'⟩ = cos of half the angle between two rotations, either sign.
        half = jnp.abs(rotation.wxyz @ rotation.wxyz[best])
        return jnp.where(half > jnp.cos(jnp.deg2rad(APART_DEG) / 2), jnp.inf, cost), best

    return jax.lax.scan(body, cost, length=count)[1]


def polished(
    T: jaxlie.SE3,
    whole: Sequence[Surface],
    before: Float[Array, ""],
    config: RegistrationConfig,
    upright: bool,
) -> jaxlie.SE3:
    """The pose aligned with more points and a short reach; as it was if that makes it fit worse."""
    source, target = (thinned(s, config.polish_points) for s in whole)
    reach = (config.last_reach, config.polish_reach)
    finer = align(T, source, target, reach, config.polish_steps, upright)
    fit = misfit(finer, source, target, (FINE * config.truncation, config.truncation))
    return jax.tree.map(lambda x, y: jnp.where(fit <= before * STAYED_RATIO + STAYED_OFFSET, x, y), finer, T)


def join(a: jaxlie.SE3, b: jaxlie.SE3) -> jaxlie.SE3:
    """Both batches of poses."""
    return jax.tree.map(lambda x, y: jnp.concatenate([x, y]), a, b)


def misfit(
    T: jaxlie.SE3, source: Surface, target: Surface, truncations: tuple[float, ...]
) -> Float[Array, ""]:
    """Mean truncated distance both ways, as a share of the truncation; 1 if the pose is not finite."""
    there, back = misfits_both_ways(T, source, target, truncations)
    return (there + back) / 2


def misfits_both_ways(
    T: jaxlie.SE3, source: Surface, target: Surface, truncations: tuple[float, ...]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mean truncated distance of the source's points and of the target's, as shares of the truncation.

    Of several truncations the mean: a far one sees the whole object, a near one a handle. Of a point near the other
    cloud it is mostly the distance off its surface: that to the nearest point has the spacing of points for a floor,
    under which details disappear. 1 if the pose is not finite.
    """
    c = correspondences(T, source, target)
    gap, count = c.target - c.source, len(source.normals)
    off = sum(jnp.sum(gap * normal, axis=-1) ** 2 for normal in (c.source_normal, c.target_normal)) / 2
    near = (1 - POINT_SHARE) * off + POINT_SHARE * c.squared
    real, finite = c.squared < FAR, jnp.isfinite(T.wxyz_xyz).all()
    shares = jnp.zeros_like(near)
    for limit in truncations:
        squared = jnp.where(c.squared < limit**2, near, c.squared)
        shares += jnp.minimum(jnp.sqrt(squared + 1e-12) / limit, 1.0) / len(truncations)

    def mean(share: Array, real: Array) -> Array:
        value = jnp.where(real, share, 0.0).sum() / jnp.maximum(real.sum(), 1)
        return jnp.where(finite & jnp.isfinite(value), value, 1.0)

    return mean(shares[:count], real[:count]), mean(shares[count:], real[count:])


def choose(costs: Float[Array, " k"], stayed_is_last: bool, doubt: Float[Array, " k"] | float = 0.0) -> Array:
    """The pose that costs least; "it did not move" (the last) if it fits nearly as well: the simplest explanation."""
    if stayed_is_last:
        costs = costs.at[-1].set((costs[-1] - STAYED_OFFSET) / STAYED_RATIO)
    return jnp.argmin(costs + doubt)


def competing(poses: jaxlie.SE3, misfits: Float[Array, " k"], best: Array) -> Bool[Array, " k"]:
    """Which poses explain the clouds about as well as the best, yet turn the object otherwise: its symmetry."""
    q = poses.rotation().wxyz
    half = jnp.abs(q @ q[best])
    apart = half < jnp.cos(jnp.deg2rad(TURNED_DEG) / 2)
    return apart & (misfits <= misfits[best] * STAYED_RATIO + STAYED_OFFSET)
