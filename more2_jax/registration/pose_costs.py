"""How well a pose lays one surface onto another: truncated distances, heights, free space, the prior's surfaces."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from more2_jax.config import MotionModel, SurfaceSearch
from more2_jax.geometry.free_space import looked_through
from more2_jax.geometry.full_precision import full_precision
from more2_jax.geometry.point_to_plane import Surface, correspondences
from more2_jax.geometry.points import FAR, transformed
from more2_jax.network.prior import Prior, field_sdf, object_field
from more2_jax.types import Embedding, Sampled, Sight

Inverse = Callable[[jaxlie.SE3], jaxlie.SE3]
Distances = tuple[float | Float[Array, ""], ...]

# Chosen on validation rooms (docs/developing/notebook/registration_parts.md).
POINT_SHARE = 0.4  # of the distance to the nearest point, in a misfit; the rest is that off its surface
OFF_FIELD = 0.1  # canonical units: farther than this from the other's completed surface is this far
ABOUT_AS_WELL = 0.2  # of misfit: poses that fit worse than the best by more are not the prior's to choose
CLEARLY = 0.05  # shares of the radius: a point so deep in free space counts in full
LIFTED = 0.1  # shares of the radius: an object lifted by this costs all of `lift_weight`
APART_DEG = 25.0  # poses kept by a search differ by at least this


def misfits_both_ways(
    T: jaxlie.SE3, source: Surface, target: Surface, truncations: Distances
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mean truncated distance of the source's points and of the target's, as shares of the truncation.

    Of several truncations the mean: a far one sees the whole object, a near one a handle. Of a point near the other
    cloud it is mostly the distance off its surface: that to the nearest point has the spacing of points for a floor,
    under which details disappear. 1 if the pose is not finite.
    """
    c = correspondences(T, source, target)
    gap, count = c.target - c.source, len(source.normals)
    off = sum(jnp.sum(gap * normal, axis=0) ** 2 for normal in (c.source_normal, c.target_normal)) / 2
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


def misfit(T: jaxlie.SE3, source: Surface, target: Surface, truncations: Distances) -> Float[Array, ""]:
    """Mean truncated distance both ways, as a share of the truncation; 1 if the pose is not finite."""
    there, back = misfits_both_ways(T, source, target, truncations)
    return (there + back) / 2


def height_cost(
    poses: jaxlie.SE3, stayed: jaxlie.SE3, search: SurfaceSearch, motion: MotionModel
) -> Float[Array, " k"]:
    """What it costs to be at another height than before: what is upright stands on the floor."""
    if motion != "upright":
        return jnp.zeros(poses.wxyz_xyz.shape[0])
    height = jnp.abs(poses.translation()[:, 2] - stayed.translation()[2])
    return search.lift_weight * jnp.minimum(height / LIFTED, 1.0)


def asks_sensors(search: SurfaceSearch, motion: MotionModel) -> bool:
    """Whether `free_space_cost` reads what sensors saw."""
    return motion == "upright" and search.free_weight > 0


def free_space_cost(
    poses: jaxlie.SE3,
    surfaces: tuple[Surface, Surface],
    sights: tuple[Sight | None, Sight | None],
    search: SurfaceSearch,
    motion: MotionModel,
) -> Float[Array, " k"]:
    """What it costs to lie where the other cloud's sensors looked through: of both clouds, the share that does.

    `surfaces` and `sights` are of source and target. Upright only: in any orientation it chose worse
    (docs/developing/notebook/registration_parts.md).
    """
    cost = jnp.zeros(poses.wxyz_xyz.shape[0])
    if not asks_sensors(search, motion):
        return cost
    ways = ((sights[1], surfaces[0], lambda T: T), (sights[0], surfaces[1], lambda T: T.inverse()))
    for sight, surface, way in ways:
        if sight is None:
            continue
        cloud = surface.sampled

        def share(T: jaxlie.SE3, sight: Sight = sight, cloud: Sampled = cloud, way: Inverse = way) -> Array:
            return looked_through(sight, transformed(way(T), cloud.points), cloud.mask, CLEARLY)

        cost += search.free_weight / 2 * jax.vmap(share)(poses)
    return cost


def about_as_good(costs: Float[Array, " k"]) -> Bool[Array, " k"]:
    """Which poses fit so well, by their costs, that the prior may tell them apart."""
    return costs <= costs.min() + ABOUT_AS_WELL


def field_cost(costs: Float[Array, " k"], off: Float[Array, " k"], weight: float) -> Float[Array, " k"]:
    """What the prior adds to the costs of poses: it tells those apart that fit about as well, and has no say beyond."""
    return weight * jnp.where(about_as_good(costs), off, 1.0)


@full_precision
def off_fields(
    prior: Prior, poses: jaxlie.SE3, clouds: tuple[Sampled, Sampled], codes: tuple[Embedding, Embedding]
) -> Float[Array, "k 2"]:
    """Of every pose, how far the source's sample lies from the surface that the prior gives the target, and the
    target's from that of the source: 0 on it, 1 `OFF_FIELD` away. A pose that is not finite has 1."""

    def both_ways(T: jaxlie.SE3) -> Float[Array, "2"]:
        there = off_field(prior, T, clouds[0], codes[1])
        return jnp.stack([there, off_field(prior, T.inverse(), clouds[1], codes[0])])

    return jax.vmap(both_ways)(poses)


@full_precision
def off_field(prior: Prior, T: jaxlie.SE3, cloud: Sampled, code: Embedding) -> Float[Array, ""]:
    """How far a moved sample lies off the completed surface of `code`, as in `off_fields`."""
    distance = jnp.abs(field_sdf(prior, object_field(prior, code), transformed(T, cloud.points)))
    share = jnp.where(cloud.mask, jnp.minimum(distance / OFF_FIELD, 1.0), 0.0)
    mean = share.sum() / jnp.maximum(cloud.mask.sum(), 1)
    return jnp.where(jnp.isfinite(mean), mean, 1.0)


def lowest_apart(
    cost: Float[Array, " n"], rotation: jaxlie.SO3, count: int, apart_deg: float = APART_DEG
) -> Int[Array, " count"]:
    """Indices of the `count` lowest costs whose rotations are at least `apart_deg` from one another.

    Many starts end in the same place; without this the few kept would be copies of one pose.
    """

    def body(cost: Array, _: None) -> tuple[Array, Array]:
        best = jnp.argmin(cost)
        # ⟨q, q'⟩ = cos of half the angle between two rotations, either sign.
        half = jnp.abs(rotation.wxyz @ rotation.wxyz[best])
        return jnp.where(half > jnp.cos(jnp.deg2rad(apart_deg) / 2), jnp.inf, cost), best

    return jax.lax.scan(body, cost, length=count)[1]


def turned_apart(poses: jaxlie.SE3, best: Int[Array, ""], angle_deg: float) -> Bool[Array, " k"]:
    """Which poses differ from the best by a turn of more than `angle_deg`."""
    q = poses.rotation().wxyz
    return jnp.abs(q @ q[best]) < jnp.cos(jnp.deg2rad(angle_deg) / 2)
