"""Pose-graph optimization: all observations of one object are aligned with one another at once.

Not in the paper. A scan is registered onto what was seen before it, one after the other, and every error stays. Here
all poses move together: an observation's points are compared with those of all others, point to plane, and every
Gauss-Newton step solves for all poses. Only surfaces that face alike are compared, so the two faces of a board, each
seen from its own side, do not pull each other together.
"""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
from jax import Array
from jaxtyping import Bool, Float

from more2_jax.config import MotionModel
from more2_jax.geometry.full_precision import full_precision
from more2_jax.geometry.point_to_plane import (
    ALONG,
    DAMPING,
    free_directions,
    moments,
    sliding,
    solve_spd,
    spacing,
)
from more2_jax.geometry.points import nearest_index
from more2_jax.types import AnyArray, pytree, quantity

# The robust kernel narrows geometrically from the first width to the last, or to so many residuals of the points off
# their own planes, whichever is more: a narrow kernel among noise hears the few points that happen to agree
# (docs/developing/notebook/pose_graph.md). Canonical units.
FIRST_WIDTH, LAST_WIDTH = 0.05, 0.001
WIDTH_RESIDUALS = 4.0
CUTOFF = 4.0  # kernel widths off a plane, from where on nothing counts: much that is far off must not pull
NORMAL_SCALE = (
    0.1  # canonical units that a difference of two unit normals of length 1 counts for in what is nearest
)


@pytree
class OrientedObservations:
    """What k scans saw of one object: points and outward unit normals in its frame, canonical units."""

    points: Float[AnyArray, "*b k n 3"] = quantity("position")
    normals: Float[AnyArray, "*b k n 3"] = quantity("direction")
    mask: Bool[AnyArray, "*b k n"] = quantity("invariant")
    residual: Float[AnyArray, "*b"] = quantity(
        "length"
    )  # how far points lie off the planes of their neighbors, typically


@partial(jax.jit, static_argnums=(1, 2))
@full_precision
def optimize_pose_graphs(
    observations: OrientedObservations, steps: int, motion: MotionModel
) -> Float[Array, "b k 4 4"]:
    """`optimize_poses` of a batch of objects, as matrices."""

    def one(observations: OrientedObservations) -> Array:
        return optimize_poses(observations, steps, motion).as_matrix()

    # On a CPU one after the other: only then is what is padding skipped, and not computed and thrown away.
    return jax.lax.map(one, observations) if jax.default_backend() == "cpu" else jax.vmap(one)(observations)


def optimize_poses(observations: OrientedObservations, steps: int, motion: MotionModel) -> jaxlie.SE3:
    """The motion (k) of every observation so that all agree; the first is held. One object, vmap outside.

    `motion` "upright": shifts, and turns about the vertical, only. An observation without points stays, too.
    """
    spacings = jax.vmap(spacing)(jnp.asarray(observations.points), jnp.asarray(observations.mask))
    last = jnp.clip(WIDTH_RESIDUALS * observations.residual, LAST_WIDTH, FIRST_WIDTH)

    def body(T: jaxlie.SE3, width: Array) -> tuple[jaxlie.SE3, None]:
        return gauss_newton_step(T, observations, spacings, width, motion), None

    start = jaxlie.SE3.identity(batch_axes=(len(spacings),))
    return jax.lax.scan(body, start, jnp.geomspace(FIRST_WIDTH, last, steps))[0]


def gauss_newton_step(
    T: jaxlie.SE3,
    observations: OrientedObservations,
    spacings: Float[Array, " k"],
    width: Float[Array, ""],
    motion: MotionModel,
) -> jaxlie.SE3:
    """One step of all poses but the first."""
    count = len(spacings)
    R = T.rotation().as_matrix()
    points = jnp.einsum("knj,kij->kni", observations.points, R, precision="highest")
    normals = jnp.einsum("knj,kij->kni", observations.normals, R, precision="highest")
    placed = dataclasses.replace(observations, points=points + T.translation()[:, None], normals=normals)

    def equations(k: Array) -> tuple[Array, Array]:
        none = jnp.zeros((count, 6, 6)), jnp.zeros((count, 6))
        return jax.lax.cond(
            placed.mask[k].any(), lambda: normal_equations(placed, k, spacings, width), lambda: none
        )

    # One at a time: the distances of all together would be held at once.
    matrix, vector = jax.lax.map(equations, jnp.arange(count))
    both = matrix + matrix.swapaxes(0, 1)  # a correspondence between k and l moves both
    H = jnp.eye(count)[:, :, None, None] * both.sum(axis=1)[:, None] - both
    right = (vector.sum(axis=1) - vector.sum(axis=0))[1:].reshape(-1)
    H = H[1:, 1:].swapaxes(1, 2).reshape(len(right), len(right))
    free = jnp.tile(free_directions(motion), count - 1)
    # Against the number of points, not the sum of weights: where hardly any has a partner, nothing is to move.
    each = placed.mask.sum() / jnp.maximum(placed.mask.any(axis=1).sum(), 1)
    H = (H + (DAMPING * each + 1e-9) * jnp.eye(len(right))) * free * free[:, None]
    step = solve_spd(H + jnp.diag(1 - free), (right * free)[:, None]).reshape(-1, 6)
    return jaxlie.SE3.exp(jnp.concatenate([jnp.zeros((1, 6)), step])) @ T


def normal_equations(
    placed: OrientedObservations, k: Array, spacings: Float[Array, " k"], width: Float[Array, ""]
) -> tuple[Float[Array, "k 6 6"], Float[Array, "k 6"]]:
    """Normal equations of observation `k`'s points against the nearest of the others', by whose those are.

    A correspondence off its plane by `width`, or along it by that and the spacing of points, counts a quarter.
    """
    points, normals, mask = placed.points, placed.normals, placed.mask
    count, size, _ = points.shape
    features = jnp.concatenate([points, NORMAL_SCALE * normals], axis=-1)
    others = jnp.asarray(mask & (jnp.arange(count) != k)[:, None]).reshape(-1)
    there = nearest_index(features[k], features.reshape(-1, 6), others)
    whose, own, gap = there // size, points[k], points.reshape(-1, 3)[there] - points[k]
    other = normals.reshape(-1, 3)[there]
    agree = jnp.sum(normals[k] * other, axis=-1)
    normal = normals[k] + other
    normal = normal / jnp.sqrt(jnp.maximum(jnp.sum(normal**2, axis=-1, keepdims=True), 1e-12))
    off = jnp.sum(normal * gap, axis=-1)
    along = jnp.maximum(jnp.sum(gap**2, axis=-1) - off**2, 0.0)
    wide = width**2 + jnp.maximum(spacings[k], spacings[whose]) ** 2
    weight = (width**2 / (width**2 + off**2) * wide / (wide + along) * jnp.maximum(agree, 0.0) ** 2) ** 2
    weight = jnp.where((jnp.abs(off) < CUTOFF * width) & mask[k] & others[there], weight, 0.0)
    to_plane = jnp.concatenate([normal, jnp.cross(own, normal), off[:, None]], axis=1).T
    to_point = jnp.concatenate([own, gap, jnp.ones_like(off)[:, None]], axis=1).T

    def onto(other: Array) -> tuple[Array, Array]:
        w = jnp.where(whose == other, weight, 0.0)
        m, (matrix, vector) = moments(to_plane, w), sliding(moments(to_point, w))
        return (1 - ALONG) * m[:6, :6] + ALONG * matrix, (1 - ALONG) * m[:6, 6] + ALONG * vector

    return jax.vmap(onto)(jnp.arange(count))
