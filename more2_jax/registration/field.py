"""Registration on completed surfaces: both clouds laid onto the field of the other's code by Gauss-Newton steps.

Beyond the paper (`FieldRegistration`), and in its sense: a pose is right where what one scan saw lies on the surface
that the prior completes the other to (§3.3). In place of a descent of small steps from one start: Gauss-Newton along
the field's slope, as in registration to a signed distance (Bylow et al., 2013), from turns all round, both ways, by a
robust distance. No correspondences and no ICP.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from more2_jax.config import FieldRegistration, MotionModel
from more2_jax.geometry.point_to_plane import free_directions, moments, solvable, solve_spd
from more2_jax.geometry.points import cloud_radius, sample, transformed, two_way_rms
from more2_jax.geometry.transform import rescale, transform
from more2_jax.network.decoder import ObjectField
from more2_jax.network.prior import Prior, field_sdf, object_field
from more2_jax.registration.descent import SampledPair
from more2_jax.registration.pair_batch import PairBatch
from more2_jax.registration.pose_costs import lowest_apart, off_fields
from more2_jax.registration.starting_poses import place, turned_rotations
from more2_jax.types import Registration, Sampled

STILL = 1e-2  # a last step below this (radians, and shares of the radius) has settled
LEAST_SLOPE = (
    0.3  # of the field, whose slope is 1 where it is a distance: a flatter one is taken as this steep
)


def register_by_field(
    prior: Prior, pairs: PairBatch, settings: FieldRegistration, motion: MotionModel
) -> Registration:
    """All pairs of a batch; from the poses handed on by matching, or from turns of the codes' own (Kabsch, §3.3)."""
    one = partial(_register_row, prior, settings=settings, motion=motion)
    if jax.default_backend() == "cpu":  # one by one: as fast, in a fraction of the memory
        return jax.lax.map(one, pairs)
    return jax.vmap(one)(pairs)


def _register_row(
    prior: Prior, pair: PairBatch, settings: FieldRegistration, motion: MotionModel
) -> Registration:
    source, target = (
        sample(s.cloud.points, s.cloud.mask, settings.points) for s in (pair.source, pair.target)
    )
    codes = pair.source.code, pair.target.code
    starts = pair.candidates
    if starts is None:
        rotations = turned_rotations(*codes, settings.turns, motion)
        starts = place(rotations, codes[0].center, codes[1].center)
    both = SampledPair(
        source=source, target=target, source_code=codes[0], target_code=codes[1], starts=starts
    )
    return register_pair(prior, both, settings, motion)


def register_pair(
    prior: Prior, pair: SampledPair, settings: FieldRegistration, motion: MotionModel
) -> Registration:
    """One pair: every start aligned by few points, the best by more, the one that lies on both surfaces returned.

    Works in units of the target's radius. `loss` is the mean truncated distance off the completed surfaces, as a
    share of the truncation. Differentiable, but where a ReLU of the decoder has its kink: there the field's slope, and
    so the step, jumps. In float32 rounding crosses such kinks: gradients through many steps want float64.
    """
    radius = cloud_radius(pair.target.points, pair.target.mask)
    pair = rescale(pair, 1 / radius)
    fields = object_field(prior, pair.source_code), object_field(prior, pair.target_code)
    few = first_rows(pair.source, settings.search_points), first_rows(pair.target, settings.search_points)
    all_points = pair.source, pair.target
    codes = pair.source_code, pair.target_code

    def aligned(poses: jaxlie.SE3, clouds: tuple[Sampled, Sampled], reaches: Array) -> jaxlie.SE3:
        return jax.vmap(lambda T: align_by(prior, T, clouds, fields, reaches, motion))(poses)

    def off(poses: jaxlie.SE3, clouds: tuple[Sampled, Sampled]) -> Float[Array, " k"]:
        return off_fields(prior, poses, clouds, codes).mean(axis=-1)

    search = jnp.geomspace(settings.first_reach, settings.search_reach, settings.search_steps)
    poses = aligned(pair.starts, few, search)
    best = lowest_apart(off(poses, few), poses.rotation(), min(settings.keep, len(poses.wxyz_xyz)))
    fine = jnp.geomspace(settings.search_reach, settings.last_reach, settings.steps)
    poses = aligned(jax.tree.map(lambda x: x[best], poses), all_points, fine)
    costs = off(poses, all_points)
    chosen = jnp.argmin(costs)
    T = jax.tree.map(lambda x: x[chosen], poses)
    last = align_step(prior, T, all_points, fields, jnp.asarray(settings.last_reach), motion)
    still = jnp.linalg.norm((last @ T.inverse()).log()) < STILL
    return rescale(scored(T, costs[chosen], still, pair, settings), radius)


def first_rows(cloud: Sampled, count: int) -> Sampled:
    """The sample's first rows, which are its farthest points, too."""
    return Sampled(
        points=cloud.points[:count],
        mask=cloud.mask[:count],
        dense=cloud.dense,
        dense_mask=cloud.dense_mask,
    )


def align_by(
    prior: Prior,
    T: jaxlie.SE3,
    clouds: tuple[Sampled, Sampled],
    fields: tuple[ObjectField, ObjectField],
    reaches: Float[Array, " steps"],
    motion: MotionModel,
) -> jaxlie.SE3:
    """A step of `align_step` with every reach in turn."""

    def body(T: jaxlie.SE3, reach: Array) -> tuple[jaxlie.SE3, None]:
        return align_step(prior, T, clouds, fields, reach, motion), None

    return jax.lax.scan(body, T, reaches)[0]


def align_step(
    prior: Prior,
    T: jaxlie.SE3,
    clouds: tuple[Sampled, Sampled],
    fields: tuple[ObjectField, ObjectField],
    reach: Float[Array, ""],
    motion: MotionModel,
) -> jaxlie.SE3:
    """One Gauss-Newton step on the distances off both completed surfaces, source and target in this order.

    A point as far off as `reach` counts a quarter (Geman-McClure). `upright`: shifts, and turns about the vertical.
    """
    R = T.rotation().as_matrix()
    moved = transformed(T, clouds[0].points)
    there, slope = offsets(prior, fields[1], moved)
    back, back_slope = offsets(prior, fields[0], transformed(T.inverse(), clouds[1].points))
    # In the target's frame, where the step turns and shifts: the source under its cloud, or its field under the other.
    points = jnp.concatenate([moved, clouds[1].points]).T
    slopes = jnp.concatenate([slope, -back_slope @ R.T]).T
    distance = jnp.concatenate([there, back])
    weight = (reach**2 / (reach**2 + distance**2)) ** 2
    weight = jnp.where(jnp.concatenate([clouds[0].mask, clouds[1].mask]), weight, 0.0)
    weight = weight / jnp.maximum(weight.sum(), 1e-12)
    m = moments(jnp.concatenate([slopes, jnp.cross(points, slopes, axis=0), distance[None]]), weight)
    free = free_directions(motion)
    step = solve_spd(solvable(m[:6, :6], motion), (-m[:6, 6] * free)[:, None])[:, 0]
    return jaxlie.SE3.exp(step) @ T


def offsets(
    prior: Prior, field: ObjectField, points: Float[Array, "n 3"]
) -> tuple[Float[Array, " n"], Float[Array, "n 3"]]:
    """How far points lie off the completed surface, negative inside, and the direction in which that grows.

    To first order: the field's value over its slope (Taubin, 1991), which is not 1 where the field is no distance.
    """
    value, pull = jax.vjp(lambda p: field.scale * field_sdf(prior, field, p), points)
    (slope,) = pull(jnp.ones_like(value))
    length = jnp.sqrt(jnp.sum(slope**2, axis=-1) + 1e-12)
    steep = jnp.maximum(length, LEAST_SLOPE)
    return value / steep, slope / steep[:, None]


def scored(
    T: jaxlie.SE3,
    cost: Float[Array, ""],
    still: Bool[Array, ""],
    pair: SampledPair,
    settings: FieldRegistration,
) -> Registration:
    """The record of a pose as it is."""
    residual = two_way_rms(transform(pair.source, T), pair.target, settings.trim)
    residual = jnp.where(jnp.isfinite(residual), residual, jnp.inf)
    converged = still & (residual < settings.converged_rms)
    return Registration(T_target_source=T, loss=cost, rms_m=residual, converged=converged)
