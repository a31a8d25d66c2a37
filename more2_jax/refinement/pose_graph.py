"""All observations of one object laid onto one another at once: its pose graph, closed over every pair.

Beyond the paper. A scan is registered onto what was seen before it, one after the other, and every slip stays. Here
all poses move together: an observation's points are compared with those of all others, point to plane, and one
Gauss-Newton step a round solves for every pose. Only sides that face alike are compared, so the two faces of a board,
each seen from its own side, do not pull each other together.
"""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
from jax import Array
from jaxtyping import Bool, Float

from more2_jax.config import ClosingConfig
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
from more2_jax.network.row_map import in_turn
from more2_jax.types import pytree

FACING = 0.1  # canonical units that a normal's change by its length counts for in what is nearest
NOISE = 4.0  # times the roughness of points: the least reach
FARTHEST = 4.0  # reaches off a plane, from where on nothing counts: what is far off must not pull, however much it is


@pytree
class Sides:
    """What observations saw of one object: points and outward normals in its frame, canonical units."""

    points: Float[Array, "*b k n 3"]
    normals: Float[Array, "*b k n 3"]
    mask: Bool[Array, "*b k n"]
    roughness: Float[Array, "*b"]  # how far off the surface points lie, typically


@partial(jax.jit, static_argnums=(1, 2))
def close_poses(sides: Sides, config: ClosingConfig, upright: bool) -> Float[Array, "b k 4 4"]:
    """`closed` of a batch of objects, as matrices."""

    def one(_: None, sides: Sides) -> Array:
        return closed(sides, config, upright).as_matrix()

    return in_turn(one, None, sides, 1)


def closed(sides: Sides, config: ClosingConfig, upright: bool) -> jaxlie.SE3:
    """By what every observation (k) moves so that all fit; the first stays where it is. One object, vmap outside.

    `upright`: shifts, and turns about the vertical, only. An observation without points stays, too.
    """
    count = len(sides.points)
    start = jaxlie.SE3.identity(batch_axes=(count,))
    apart = jax.vmap(spacing)(sides.points, sides.mask)
    # Among noise a short reach hears the few points that happen to agree.
    last = jnp.clip(NOISE * sides.roughness, config.last_reach, config.first_reach)
    reaches = jnp.geomspace(config.first_reach, last, config.steps)

    def body(T: jaxlie.SE3, reach: Array) -> tuple[jaxlie.SE3, None]:
        return close_step(T, sides, apart, reach, upright), None

    return jax.lax.scan(body, start, reaches)[0]


def close_step(
    T: jaxlie.SE3, sides: Sides, apart: Float[Array, " k"], reach: Float[Array, ""], upright: bool
) -> jaxlie.SE3:
    """One Gauss-Newton step of all poses but the first."""
    count = len(apart)
    R = T.rotation().as_matrix()
    points = jnp.einsum("knj,kij->kni", sides.points, R, precision="highest") + T.translation()[:, None]
    normals = jnp.einsum("knj,kij->kni", sides.normals, R, precision="highest")
    placed = dataclasses.replace(sides, points=points, normals=normals)

    def of(k: Array) -> tuple[Array, Array]:
        none = jnp.zeros((count, 6, 6)), jnp.zeros((count, 6))
        return jax.lax.cond(
            placed.mask[k].any(), lambda: pair_equations(placed, k, apart, reach), lambda: none
        )

    # One at a time: the distances of all together would be held at once.
    matrix, vector = jax.lax.map(of, jnp.arange(count))
    both = matrix + matrix.swapaxes(0, 1)  # what k sees of l moves both
    H = jnp.eye(count)[:, :, None, None] * both.sum(axis=1)[:, None] - both
    right = (vector.sum(axis=1) - vector.sum(axis=0))[1:].reshape(-1)
    H = H[1:, 1:].swapaxes(1, 2).reshape(len(right), len(right))
    free = jnp.tile(free_directions("upright" if upright else "free"), count - 1)
    # Against the number of points, not the sum of weights: where hardly any has a partner, nothing is to move.
    each = placed.mask.sum() / jnp.maximum(placed.mask.any(axis=1).sum(), 1)
    H = (H + (DAMPING * each + 1e-9) * jnp.eye(len(right))) * free * free[:, None]
    step = solve_spd(H + jnp.diag(1 - free), (right * free)[:, None]).reshape(-1, 6)
    return jaxlie.SE3.exp(jnp.concatenate([jnp.zeros((1, 6)), step])) @ T


def pair_equations(
    placed: Sides, k: Array, apart: Float[Array, " k"], reach: Float[Array, ""]
) -> tuple[Float[Array, "k 6 6"], Float[Array, "k 6"]]:
    """Normal equations of observation `k`'s points against the nearest of the others', by whose those are.

    A correspondence off its plane by `reach`, or along it by that and the spacing of points, counts a quarter.
    """
    points, normals, mask = placed.points, placed.normals, placed.mask
    count, size, _ = points.shape
    everywhere = jnp.concatenate([points, FACING * normals], axis=-1)
    others = mask & (jnp.arange(count) != k)[:, None]
    there = nearest_index(everywhere[k], everywhere.reshape(-1, 6), others.reshape(-1))
    own, gap = points[k], points.reshape(-1, 3)[there] - points[k]
    other = normals.reshape(-1, 3)[there]
    agree = jnp.sum(normals[k] * other, axis=-1)
    normal = normals[k] + other
    normal = normal / jnp.sqrt(jnp.maximum(jnp.sum(normal**2, axis=-1, keepdims=True), 1e-12))
    off = jnp.sum(normal * gap, axis=-1)
    along = jnp.maximum(jnp.sum(gap**2, axis=-1) - off**2, 0.0)
    whose = there // size
    wide = reach**2 + jnp.maximum(apart[k], apart[whose]) ** 2
    weight = (reach**2 / (reach**2 + off**2) * wide / (wide + along) * jnp.maximum(agree, 0.0) ** 2) ** 2
    near = jnp.abs(off) < FARTHEST * reach
    weight = jnp.where(near & mask[k] & others.reshape(-1)[there], weight, 0.0)
    leaving = jnp.concatenate([normal, jnp.cross(own, normal), off[:, None]], axis=1).T
    slid = jnp.concatenate([own, gap, jnp.ones_like(off)[:, None]], axis=1).T

    def onto(row: Array) -> tuple[Array, Array]:
        w = jnp.where(whose == row, weight, 0.0)
        m, (matrix, vector) = moments(leaving, w), sliding(moments(slid, w))
        return (1 - ALONG) * m[:6, :6] + ALONG * matrix, (1 - ALONG) * m[:6, 6] + ALONG * vector

    return jax.vmap(onto)(jnp.arange(count))
