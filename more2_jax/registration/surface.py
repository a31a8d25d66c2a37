"""Registration of pairs by their surfaces: the poses that a search found refined, the best told by what they explain.

Beyond the paper (`SurfaceRegistration`): point-to-plane alignment both ways takes the place of the descent on the
field, and poses are compared by the share of both clouds that finds its like, not by a residual that the unseen
spoils. What has no like in the other cloud may still lie on the surface that the prior completes it with: poses that
fit about as well are told apart by that.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from more2_jax.config import MotionModel, SurfaceRegistration
from more2_jax.geometry.full_precision import full_precision
from more2_jax.geometry.point_to_plane import Surface, align, align_step, pose_covariance, thinned
from more2_jax.geometry.points import two_way_rms
from more2_jax.geometry.transform import rescale, transform
from more2_jax.network.prior import Prior
from more2_jax.network.row_map import chunked
from more2_jax.registration.pair_batch import PairBatch
from more2_jax.registration.pose_costs import (
    about_as_good,
    field_cost,
    free_space_cost,
    height_cost,
    lowest_apart,
    misfit,
    off_fields,
    turned_apart,
)
from more2_jax.registration.search import (
    AlignableObject,
    alignable,
    concatenated,
    scaled_pose,
    search_poses,
)
from more2_jax.registration.starting_poses import masked_mean
from more2_jax.types import Registration

PAIRS_A_CALL = 1  # refined in a call, on CPUs one after the other anyway: nothing is worked on to fill a call
STILL = 1e-2  # a last step below this (radians, and shares of the radius) has settled
# How much worse "it did not move" may fit and still be chosen; so much worse, another pose still competes.
STAYED_RATIO, STAYED_OFFSET = 1.1, 0.01
# A center that is shifted by less, a share of the radius, has not moved; a turn by less may be an error; what a turn in
# place must fit better than no motion.
IN_PLACE, NOT_TURNED_DEG, TURNED_RATIO, TURNED_OFFSET = 0.25, 15.0, 1.2, 0.01
FINE = 0.25  # share of the truncation: the nearer one by which refined poses are told apart
TURNED_DEG = 15.0  # competing poses differ by more

# "It did not move", and whether that is known, whatever fits closer.
Stayed = tuple[jaxlie.SE3, Bool[Array | np.ndarray, "*batch"]]


def register_by_surfaces(
    prior: Prior, pairs: PairBatch, settings: SurfaceRegistration, motion: MotionModel
) -> Registration:
    """All pairs of a batch: their candidates refined, or those of a search of their own where they have none."""
    source, target = pairs.prepared or tuple(
        alignable(side, settings.search) for side in (pairs.source, pairs.target)
    )
    candidates = pairs.candidates
    if candidates is None:
        candidates = search_poses(source, target, pairs.stayed, settings.search, motion).poses
    stands = jnp.zeros(len(pairs), bool) if pairs.stands is None else pairs.stands
    return refine_poses(prior, (source, target), candidates, (pairs.stayed, stands), settings, motion)


def refine_poses(
    prior: Prior,
    objects: tuple[AlignableObject, AlignableObject],
    candidates: jaxlie.SE3,
    stayed: Stayed,
    settings: SurfaceRegistration,
    motion: MotionModel,
) -> Registration:
    """Refines `candidates` (b, k) of pairs of `objects` (source, target); meters, local frames."""
    one_call = partial(_refine_poses, prior, settings=settings, motion=motion)
    return chunked(one_call, PAIRS_A_CALL, (*objects, candidates, stayed))


@partial(jax.jit, static_argnames=("settings", "motion"))
@full_precision
def _refine_poses(
    prior: Prior,
    pairs: tuple[AlignableObject, AlignableObject, jaxlie.SE3, Stayed],
    settings: SurfaceRegistration,
    motion: MotionModel,
) -> Registration:
    def one(
        source: AlignableObject, target: AlignableObject, candidates: jaxlie.SE3, stayed: Stayed
    ) -> Registration:
        return refine_pair(prior, source, target, candidates, stayed, settings, motion)

    if jax.default_backend() == "cpu":  # one by one: what the prior is not asked about then costs nothing
        return jax.lax.map(lambda pair: one(*pair), pairs)
    return jax.vmap(one)(*pairs)


def refine_pair(
    prior: Prior,
    source: AlignableObject,
    target: AlignableObject,
    candidates: jaxlie.SE3,
    held: Stayed,
    settings: SurfaceRegistration,
    motion: MotionModel,
) -> Registration:
    """One pair: the best of its poses refined, its covariance, and the poses that explain the clouds as well.

    In units of the target's radius. `loss` and `misfit`: truncated distance. Differentiable for held correspondences.
    """
    radius = target.radius
    source, target = rescale(source, 1 / radius), rescale(target, 1 / radius)
    starts, stayed = scaled_pose(candidates, 1 / radius), scaled_pose(held[0], 1 / radius)
    s, t = thinned(source.full(), settings.points), thinned(target.full(), settings.points)
    poses = refined(starts, stayed, s, t, settings, motion)
    misfits = jax.vmap(lambda T: misfit(T, s, t, truncations(settings)))(poses)
    costs = misfits + height_cost(poses, stayed, settings.search, motion)
    costs += free_space_cost(poses, (s, t), (source.sight, target.sight), settings.search, motion)
    chosen = finalists(costs, poses, settings)
    poses, misfits, costs = jax.tree.map(lambda x: x[chosen], (poses, misfits, costs))
    doubt = prior_cost(prior, poses, costs, (source, target), settings)
    moved = motion_since(stayed, poses, masked_mean(s.sampled.points, s.sampled.mask))
    best, costs = decided(costs, doubt, moved, settings.try_stayed)
    best = jnp.where(held[1] & settings.try_stayed, len(misfits) - 1, best)
    T = jax.tree.map(lambda x: x[best], poses)
    T = aligned = polished(T, (source, target), misfits[best], settings, motion)
    if settings.try_stayed:  # what stayed is exactly where it was
        T = jax.tree.map(lambda x, y: jnp.where(best == len(misfits) - 1, y, x), T, stayed)
    found = dataclasses.replace(
        scored(T, s, t, settings, motion),
        loss=misfits[best],
        misfit=misfits[best],
        aligned=aligned,
        competing=poses,
        competes=turned_apart(poses, best, TURNED_DEG) & nearly_as_good(costs + doubt, best),
    )
    return rescale(found, radius)


def refined(
    starts: jaxlie.SE3,
    stayed: jaxlie.SE3,
    source: Surface,
    target: Surface,
    settings: SurfaceRegistration,
    motion: MotionModel,
) -> jaxlie.SE3:
    """Every start aligned; where it is tried, also "it did not move", aligned and exactly as it is (the last)."""
    one = jax.tree.map(lambda x: x[None], stayed)
    if settings.try_stayed:
        starts = concatenated(starts, one)
    reach = (settings.first_reach, settings.last_reach)
    poses = jax.vmap(lambda T: align(T, source, target, reach, settings.steps, motion))(starts)
    return concatenated(poses, one) if settings.try_stayed else poses


def truncations(settings: SurfaceRegistration) -> tuple[float, float]:
    """The near and the far distance at which misfits are truncated."""
    return (FINE * settings.search.truncation, settings.search.truncation)


def finalists(
    costs: Float[Array, " k"], poses: jaxlie.SE3, settings: SurfaceRegistration
) -> Int[Array, " f"]:
    """The poses to choose from: the best, each turned otherwise, and "it did not move" (the last) where it is tried."""
    rest = len(costs) - settings.try_stayed
    rotation = jax.tree.map(lambda x: x[:rest], poses).rotation()
    best = lowest_apart(costs[:rest], rotation, min(settings.choose_among, rest))
    return jnp.append(best, len(costs) - 1) if settings.try_stayed else best


def prior_cost(
    prior: Prior,
    poses: jaxlie.SE3,
    costs: Float[Array, " k"],
    objects: tuple[AlignableObject, AlignableObject],
    settings: SurfaceRegistration,
) -> Float[Array, " k"]:
    """What the prior adds to the costs of poses; nothing where it is not asked."""
    weight = settings.search.field_weight
    if not weight:
        return jnp.zeros_like(costs)
    clouds = tuple(thinned(o.full(), settings.field_points).sampled for o in objects)
    codes = objects[0].code, objects[1].code

    def off_of(k: Array) -> Float[Array, ""]:
        one = jax.tree.map(lambda x: x[k][None], poses)
        return off_fields(prior, one, clouds, codes).mean()  # type: ignore[arg-type]

    return asked_in_order(off_of, costs, weight)


def asked_in_order(
    off_of: Callable[[Array], Float[Array, ""]], costs: Float[Array, " k"], weight: float
) -> Float[Array, " k"]:
    """`field_cost` by `off_of` of every pose that it can decide about, 0 for the others that fit about as well.

    Asked in the order of the costs. Not asked about is a pose that fits so much worse than one asked before that it
    would neither win nor compete if it lay on the completed surfaces exactly; none is if there is no other to choose.
    """
    near = about_as_good(costs)

    def ask(least: Array, k: Array) -> tuple[Array, Array]:
        # Twice, as "it did not move" may be chosen by the first, and others compete with it by the second.
        asked = near[k] & (near.sum() > 1) & (costs[k] <= as_good_as(as_good_as(least)))
        off = jax.lax.cond(asked, off_of, lambda k: jnp.zeros((), costs.dtype), k)
        return jnp.where(asked, jnp.minimum(least, costs[k] + weight * off), least), off

    order = jnp.argsort(costs)
    _, off = jax.lax.scan(ask, jnp.asarray(jnp.inf, costs.dtype), order)
    return field_cost(costs, jnp.zeros_like(costs).at[order].set(off), weight)


def decided(
    costs: Float[Array, " k"],
    doubt: Float[Array, " k"],
    moved: tuple[Float[Array, " k"], Float[Array, " k"]],
    stayed_is_last: bool,
) -> tuple[Array, Float[Array, " k"]]:
    """The pose taken, and what all of them cost, turns in place included. `moved`: of `motion_since`."""
    if not stayed_is_last:
        return choose(costs, False, doubt), costs
    costs += turned_in_place(moved, costs)
    return simplest(choose(costs, True, doubt), costs, moved), costs


def choose(costs: Float[Array, " k"], stayed_is_last: bool, doubt: Float[Array, " k"] | float = 0.0) -> Array:
    """The pose that costs least; "it did not move" (the last) if it fits nearly as well: the simplest explanation."""
    if stayed_is_last:
        costs = costs.at[-1].set(simply(costs[-1]))
    return jnp.argmin(costs + doubt)


def simplest(
    best: Array, costs: Float[Array, " k"], moved: tuple[Float[Array, " k"], Float[Array, " k"]]
) -> Array:
    """The chosen pose, or "it did not move" (the last) if that hardly differs and fits nearly as well.

    The prior has no say in that: a pose that was aligned lies on what it completes as it lies on what was seen; one
    that was not is off both by what drift leaves, and the prior would have what stayed move by a little every time.
    """
    shift, turned = (x[best] for x in moved)
    same = (shift < IN_PLACE) & (turned <= jnp.deg2rad(NOT_TURNED_DEG))
    return jnp.where(same & (simply(costs[-1]) <= costs[best]), len(costs) - 1, best)


def simply(cost: Float[Array, ""]) -> Float[Array, ""]:
    """What "it did not move" costs, beside poses that are less simple."""
    return (cost - STAYED_OFFSET) / STAYED_RATIO


def motion_since(
    stayed: jaxlie.SE3, poses: jaxlie.SE3, center: Float[Array, " 3"]
) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """How far every pose puts a cloud's center from where it was, and by what angle it turns it, radians."""
    shift = jnp.linalg.norm(jax.vmap(lambda T: T @ center)(poses) - stayed @ center, axis=-1)
    return shift, jnp.linalg.norm((poses.rotation() @ stayed.rotation().inverse()).log(), axis=-1)


def turned_in_place(
    moved: tuple[Float[Array, " k"], Float[Array, " k"]], costs: Float[Array, " k"]
) -> Float[Array, " k"]:
    """What poses cost that leave a cloud's center where it was: things that are not moved are seldom turned.

    What is round, or nearly the same turned around, would seem to turn at every scan. `moved`: of `motion_since`.
    """
    shift, turned = moved
    in_place = (shift < IN_PLACE) & (turned > jnp.deg2rad(NOT_TURNED_DEG))
    return jnp.where(in_place, (TURNED_RATIO - 1) * costs + TURNED_OFFSET, 0.0)


def nearly_as_good(costs: Float[Array, " k"], best: Array) -> Bool[Array, " k"]:
    """Which poses explain the clouds about as well as the best."""
    return costs <= as_good_as(costs[best])


def as_good_as(cost: Float[Array, ""]) -> Float[Array, ""]:
    """The highest cost that counts as nearly as good."""
    return cost * STAYED_RATIO + STAYED_OFFSET


def polished(
    T: jaxlie.SE3,
    objects: tuple[AlignableObject, AlignableObject],
    before: Float[Array, ""],
    settings: SurfaceRegistration,
    motion: MotionModel,
) -> jaxlie.SE3:
    """The pose aligned with more points and a short reach; as it was if that makes it fit worse."""
    source, target = (thinned(o.full(), settings.polish_points) for o in objects)
    reach = (settings.last_reach, settings.polish_reach)
    finer = align(T, source, target, reach, settings.polish_steps, motion)
    fit = misfit(finer, source, target, truncations(settings))
    return jax.tree.map(lambda x, y: jnp.where(fit <= as_good_as(before), x, y), finer, T)


def scored(
    T: jaxlie.SE3, source: Surface, target: Surface, settings: SurfaceRegistration, motion: MotionModel
) -> Registration:
    """The record of a pose: residual, covariance, and whether it has settled."""
    rms = two_way_rms(transform(source.sampled, T), target.sampled, settings.trim)
    last = align_step(T, source, target, jnp.asarray(settings.last_reach), motion)
    still = jnp.linalg.norm((last @ T.inverse()).log()) < STILL
    return Registration(
        T_target_source=T,
        loss=rms,
        rms_m=jnp.where(jnp.isfinite(rms), rms, jnp.inf),
        converged=still & (rms < settings.converged_rms),
        covariance=pose_covariance(T, source, target, settings.last_reach, motion),
    )
