"""What is known of pairs of objects that may be one: how their surfaces fit at the poses that a search found.

Beyond the paper (`EvidenceMatcher`): the embedding proposes, surfaces decide. In any orientation more poses fit by
chance, and no heights tell pairs apart: there the prior is asked too, whether each cloud lies on what it completes
the other to.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, Int

from more2_jax.config import MotionModel, SurfaceSearch
from more2_jax.geometry.transform import rescale
from more2_jax.network.prior import Prior
from more2_jax.network.remembered_rows import only_new
from more2_jax.network.row_map import chunked, chunked_at
from more2_jax.registration.pose_costs import field_cost, off_field, off_fields
from more2_jax.registration.search import AlignableObject, FoundPoses, rows_taken, scaled_pose
from more2_jax.types import Sampled

OBJECTS_A_CALL = 2
PAIRS_A_CALL = 4
FEW = 4  # of a cloud's points every fourth says which poses lie best on the completed surfaces,
LEADING = 2  # and all of them, of so many poses, which of these


@dataclass(frozen=True, kw_only=True)
class PairEvidence:
    """What aligning p pairs says of each, at the pose that fits best; host arrays."""

    pose: Int[np.ndarray, " p"]  # which of the poses found that is
    # `MetricEvidence` at that pose: mean distances in shares of `APART_M`, and the share in empty space.
    apart_source: Float[np.ndarray, " p"]
    apart_target: Float[np.ndarray, " p"]
    contradicted: Float[np.ndarray, " p"]
    lift_m: Float[np.ndarray, " p"]  # change of height
    radius_m: Float[np.ndarray, " p"]  # of the target
    # How far, 0 to 1, the source's points lie off the target's completed surface, the target's off the source's, and
    # either off its own at most: what the prior does not even know. All 0 where that is not asked.
    off_source: Float[np.ndarray, " p"]
    off_target: Float[np.ndarray, " p"]
    off_own: Float[np.ndarray, " p"]


def asks_prior(search: SurfaceSearch, motion: MotionModel) -> bool:
    """Whether completed surfaces are evidence of who is who."""
    return motion == "free" and search.field_weight > 0


def off_completed_surfaces(
    prior: Prior,
    sides: tuple[AlignableObject, AlignableObject],
    rows: Int[np.ndarray, "p 2"],
    found: FoundPoses,
    search: SurfaceSearch,
) -> tuple[FoundPoses, Float[np.ndarray, "p k 2"]]:
    """The poses of every pair in the order that the prior's surfaces give them, and `off_fields` of each.

    By a few points of each cloud; of the first `LEADING` by all, which order these. `rows`: of sources and targets.
    """
    one_call = partial(_off_completed_surfaces, prior, search=search)

    def taken(at: Int[np.ndarray, " k"]) -> tuple[AlignableObject, AlignableObject, FoundPoses]:
        return *rows_taken(sides, rows[at]), jax.tree.map(lambda x: x[at], found)

    return only_new(
        one_call,
        len(rows),
        taken,
        lambda at: chunked_at(one_call, PAIRS_A_CALL, len(at), lambda some: taken(at[some])),
    )


@partial(jax.jit, static_argnames="search")
def _off_completed_surfaces(
    prior: Prior, pairs: tuple[AlignableObject, AlignableObject, FoundPoses], search: SurfaceSearch
) -> tuple[FoundPoses, Float[Array, "p k 2"]]:
    def one(
        pair: tuple[AlignableObject, AlignableObject, FoundPoses],
    ) -> tuple[FoundPoses, Float[Array, "k 2"]]:
        source, target, found = pair
        s, t = (rescale(x, 1 / target.radius) for x in (source, target))
        clouds, poses = (s.coarse.sampled, t.coarse.sampled), scaled_pose(found.poses, 1 / target.radius)
        few = tuple(every_nth(c, FEW) for c in clouds)
        off = off_fields(prior, poses, few, (s.code, t.code))  # type: ignore[arg-type]
        cost = found.cost + field_cost(found.cost, off.mean(axis=1), search.field_weight)
        order = jnp.argsort(cost)
        lead = order[:LEADING]
        exact = off_fields(prior, jax.tree.map(lambda x: x[lead], poses), clouds, (s.code, t.code))
        off = off.at[lead].set(exact)
        exact_cost = found.cost + field_cost(found.cost, off.mean(axis=1), search.field_weight)
        order = order.at[:LEADING].set(lead[jnp.argsort(exact_cost[lead])])
        return jax.tree.map(lambda x: x[order], (found, off))

    return jax.lax.map(one, pairs, batch_size=None if jax.default_backend() == "cpu" else 8)


def every_nth(cloud: Sampled, n: int) -> Sampled:
    """A sample thinned once more."""
    return dataclasses.replace(cloud, points=cloud.points[::n], mask=cloud.mask[::n])


def off_own_surface(prior: Prior, objects: AlignableObject) -> Float[np.ndarray, " b"]:
    """How far the points of objects lie off the surfaces that the prior completes them to: 0 to 1."""
    return np.asarray(chunked(partial(_off_own_surface, prior), OBJECTS_A_CALL, objects))


@jax.jit
def _off_own_surface(prior: Prior, objects: AlignableObject) -> Float[Array, " b"]:
    def one(o: AlignableObject) -> Float[Array, ""]:
        return off_field(prior, jaxlie.SE3.identity(), o.coarse.sampled, o.code)

    return jax.lax.map(one, objects)
