"""The search for a pair's poses: every start aligned by coarse surfaces, the few that fit best kept.

Matching asks it of every candidate pair, and hands the poses it found to registration, which refines them. An object
is prepared once, whatever number of pairs it is part of.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, Int

from more2_jax.config import MotionModel, SurfaceSearch
from more2_jax.geometry.full_precision import full_precision
from more2_jax.geometry.point_to_plane import Surface, align_by, coarsened, surrounded, whole_surface
from more2_jax.geometry.points import cloud_radius
from more2_jax.geometry.transform import rescale
from more2_jax.network.remembered_rows import only_new
from more2_jax.network.row_map import chunked, chunked_at, traced
from more2_jax.registration.pose_costs import (
    free_space_cost,
    height_cost,
    lowest_apart,
    misfits_both_ways,
)
from more2_jax.registration.starting_poses import candidate_poses, masked_mean
from more2_jax.types import AnyArray, Embedding, LocalBatch, Sight, pytree, quantity

# Calls of one shape, so that scenes share compiled programs, and small, so that few fillers are worked on.
OBJECTS_A_CALL = 1  # prepared in a call, on CPUs one after the other anyway
# Searched in a call, on CPUs one after the other; on accelerators so many times as many.
PAIRS_A_CALL, WIDER = 4, 16
# In any orientation every start is aligned for a third of the steps, and the best third of them go on: as right as all
# of them for two thirds of the work (docs/developing/notebook/speed_scene.md). Upright there are fewer, of which all
# have all steps.
ROUNDS = 3
SAME_DEG = 10.0  # of starts that have come this near to one another's rotation the best alone goes on


@pytree
class AlignableObject:
    """An object ready to be aligned, in its local frame, meters."""

    # All of its points, with normals, and what lies around them; None where only a search is to follow.
    whole: Surface | None = quantity("record")
    coarse: Surface = quantity("record")  # what a search compares
    radius: Float[AnyArray, "*b"] = quantity("length")
    code: Embedding = quantity("record")
    sight: Sight | None = quantity("record", default=None)

    def full(self) -> Surface:
        """All of its points. Raises ValueError where it was kept for a search alone."""
        if self.whole is None:
            raise ValueError("registration got objects kept for a search alone; needed them as prepared")
        return self.whole


@pytree
class FoundPoses:
    """The poses of one pair that are worth refining, best first, and how well each fits."""

    poses: jaxlie.SE3 = quantity("pose")  # (*b, k): source's local frame to target's
    cost: Float[AnyArray, "*b k"] = quantity("invariant")  # by which they are ordered


def alignable(batch: LocalBatch, search: SurfaceSearch) -> AlignableObject:
    """Every object of a batch with its normals, what lies around it, and its coarse surface."""
    local = LocalBatch(cloud=batch.cloud, code=batch.code, sight=batch.sight, around=batch.around)
    one_call = partial(_alignable, search=search)
    if traced(local):
        return one_call(local)
    host = jax.tree.map(np.asarray, local)

    def taken(at: Int[np.ndarray, " k"]) -> LocalBatch:
        return jax.tree.map(lambda x: x[at], host)

    return only_new(
        one_call, len(host.cloud.mask), taken, lambda at: chunked(one_call, OBJECTS_A_CALL, taken(at))
    )


@partial(jax.jit, static_argnames="search")
@full_precision
def _alignable(batch: LocalBatch, search: SurfaceSearch) -> AlignableObject:
    def one(row: LocalBatch) -> AlignableObject:
        mask = row.cloud.mask
        points = jnp.where(mask[:, None], row.cloud.points, 0.0)  # NaN in masked rows goes no further
        whole = whole_surface(points, mask, row.cloud.normals)
        if row.around is not None:
            near = jnp.where(row.around.mask[:, None], row.around.points, 0.0)
            whole = surrounded(whole, near, row.around.mask)
        coarse = coarsened(whole, search.points, search.dense, search.cells)
        radius = cloud_radius(points, mask)
        return AlignableObject(whole=whole, coarse=coarse, radius=radius, code=row.code, sight=row.sight)

    return jax.lax.map(one, batch)


def searched(o: AlignableObject) -> AlignableObject:
    """The object without what no search reads: two fifths of its memory, and as much again for its anchors."""
    return dataclasses.replace(o, whole=None, code=dataclasses.replace(o.code, anchors=()))


def search_poses(
    source: AlignableObject,
    target: AlignableObject,
    stayed: jaxlie.SE3,
    search: SurfaceSearch,
    motion: MotionModel,
    rows: Int[np.ndarray, "b 2"] | None = None,
) -> FoundPoses:
    """The poses of a batch of pairs, row i of `source` onto row i of `target`; meters, local frames.

    `stayed` (b,): where each source would be had it not moved. `rows` names the pairs (row of `source`, of `target`)
    where an object is part of several.
    """
    one_call = partial(_search_poses, search=search, motion=motion)
    source, target = searched(source), searched(target)
    if rows is None:
        return chunked(one_call, PAIRS_A_CALL, (source, target, stayed), WIDER)

    def taken(at: Int[np.ndarray, " k"]) -> tuple[AlignableObject, AlignableObject, jaxlie.SE3]:
        return *rows_taken((source, target), rows[at]), jax.tree.map(lambda x: x[at], stayed)

    return only_new(
        one_call,
        len(rows),
        taken,
        lambda at: chunked_at(one_call, PAIRS_A_CALL, len(at), lambda some: taken(at[some]), WIDER),
    )


def rows_taken(
    sides: tuple[AlignableObject, AlignableObject], rows: Int[np.ndarray, "b 2"]
) -> tuple[AlignableObject, AlignableObject]:
    """Sources and targets of pairs that are named by rows of both."""
    first, second = (
        jax.tree.map(lambda x, at=at: x[at], side) for side, at in zip(sides, rows.T, strict=True)
    )
    return first, second


@partial(jax.jit, static_argnames=("search", "motion"))
@full_precision
def _search_poses(
    pairs: tuple[AlignableObject, AlignableObject, jaxlie.SE3], search: SurfaceSearch, motion: MotionModel
) -> FoundPoses:
    def one(pair: tuple[AlignableObject, AlignableObject, jaxlie.SE3]) -> FoundPoses:
        return search_pair(*pair, search, motion)

    if jax.default_backend() == "cpu":  # what the starts of one pair are compared by stays in the caches
        return jax.lax.map(one, pairs)
    return jax.vmap(one)(pairs)


def search_pair(
    source: AlignableObject,
    target: AlignableObject,
    stayed: jaxlie.SE3,
    search: SurfaceSearch,
    motion: MotionModel,
) -> FoundPoses:
    """One pair; works in units of the target's radius. Differentiable, the correspondences held."""
    radius = target.radius
    s, t, stayed = rescale(source, 1 / radius), rescale(target, 1 / radius), scaled_pose(stayed, 1 / radius)
    means = tuple(masked_mean(x.coarse.sampled.points, x.coarse.sampled.mask) for x in (s, t))
    starts = candidate_poses((s.code, t.code), means, stayed, search.turns, motion)  # type: ignore[arg-type]

    def aligned(poses: jaxlie.SE3, reaches: Float[Array, " steps"]) -> FoundPoses:
        poses = jax.vmap(lambda T: align_by(T, s.coarse, t.coarse, reaches, motion))(poses)
        misfits = jax.vmap(lambda T: misfits_both_ways(T, s.coarse, t.coarse, (search.truncation,)))(poses)
        cost = sum(misfits) / 2 + height_cost(poses, stayed, search, motion)
        cost += free_space_cost(poses, (s.coarse, t.coarse), (s.sight, t.sight), search, motion)
        return FoundPoses(poses=poses, cost=cost)

    found = in_rounds(starts, aligned, search, ROUNDS if motion == "free" else 1)
    best = lowest_apart(found.cost, found.poses.rotation(), min(search.keep, len(found.cost)))
    return rescale(jax.tree.map(lambda x: x[best], found), radius)


def in_rounds(
    starts: jaxlie.SE3,
    aligned: Callable[[jaxlie.SE3, Float[Array, " steps"]], FoundPoses],
    search: SurfaceSearch,
    rounds: int,
) -> FoundPoses:
    """The best of the starts, one of so many as there are `rounds` of steps, told after the first: aligned by all.

    `aligned` takes poses and the reaches of some steps. As many poses have their turn each time, so that it is
    compiled once: one part of the starts after the other, then the best, round by round.
    """
    count, steps = -(-len(starts.wxyz_xyz) // rounds), -(-search.steps // rounds)
    reaches = jnp.geomspace(search.first_reach, search.last_reach, rounds * steps).reshape(rounds, steps)
    fillers = rounds * count - len(starts.wxyz_xyz)
    every = jax.tree.map(lambda x: jnp.concatenate([x, x[:fillers]]), starts)
    found = FoundPoses(poses=every, cost=jnp.ones(rounds * count))

    def turn(
        carry: tuple[FoundPoses, Int[Array, " c"]], step: tuple[Array, Array]
    ) -> tuple[tuple[FoundPoses, Int[Array, " c"]], None]:
        (found, rows), (number, reach) = carry, step
        best = partial(lowest_apart, found.cost, found.poses.rotation(), count, SAME_DEG)
        rows = jax.lax.switch(
            jnp.clip(number - rounds + 1, 0, 2),
            (lambda: number * count + jnp.arange(count), lambda: best().astype(rows.dtype), lambda: rows),
        )
        some = aligned(jax.tree.map(lambda x: x[rows], found.poses), reach)
        return (jax.tree.map(lambda x, y: x.at[rows].set(y), found, some), rows), None

    turns = jnp.arange(2 * rounds - 1)
    steps_of = turns, reaches[jnp.maximum(turns - rounds + 1, 0)]
    (found, rows), _ = jax.lax.scan(turn, (found, jnp.arange(count)), steps_of)
    return jax.tree.map(lambda x: x[rows], found)


def scaled_pose(T: jaxlie.SE3, factor: Float[Array, ""]) -> jaxlie.SE3:
    """The pose in other units of length."""
    return jaxlie.SE3.from_rotation_and_translation(T.rotation(), T.translation() * factor)


def concatenated(a: jaxlie.SE3, b: jaxlie.SE3) -> jaxlie.SE3:
    """Both batches of poses."""
    return jax.tree.map(lambda x, y: jnp.concatenate([x, y]), a, b)
