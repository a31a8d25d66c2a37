"""Which way is outward: the votes and the signed graph of `meshing.normal_orientation`, rays in closed form.

None of it has a gradient: a side is one of two.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from more2_jax.meshing.device.rows import at_rows, masked_median
from more2_jax.meshing.normal_orientation import (
    CONE_SLOPE,
    CREASE_POWER,
    FIELD_WEIGHT,
    GEOMETRY_WEIGHT,
    GRAPH_NEIGHBORS,
    GRAZING_COSINE,
    LINE_OF_SIGHT_SLOPE,
    MAX_DISTANCE,
    MAX_ITERATIONS,
    MAX_STEPS,
    MAX_VOTERS,
    STEP_RATIO,
    TOLERANCE,
    VOTE_WEIGHT,
)
from more2_jax.types import AnyArray, pytree, quantity

RAYS_AT_ONCE = 128

Points = Float[Array, "n 3"]
Values = Float[Array, " n"]


@pytree
class Cloud:
    """Real points first; canonical units."""

    points: Points = quantity("position")
    mask: Bool[Array, " n"] = quantity("invariant")
    distance: Float[Array, "n k"] = quantity("length")  # to the nearest points, itself among them,
    neighbors: Int[Array, "n k"] = quantity("invariant")  # and which these are
    gap: Float[Array, ""] = quantity("length")  # from here on rays are tested
    lowest: Float[Array, ""] = quantity("length")  # below this height there is no free space


@pytree
class Views:
    """What a scan says of sides: sensors that saw a point (NaN fills up), normals (zeros where not known)."""

    sensors: Float[AnyArray, "*b n s 3"] = quantity("position")
    normals: Float[AnyArray, "*b n 3"] = quantity("direction")
    known: Bool[AnyArray, "*b"] = quantity("invariant")  # whether it says either


def outward_signs(cloud: Cloud, normal: Points, slope: Values, views: Views) -> Values:
    """+1 where a point's normal goes outward, −1 where inward; `slope`: by how much the field rises along it."""
    cloud, normal, slope, views = jax.lax.stop_gradient((cloud, normal, slope, views))
    count = cloud.mask.sum()
    size = min(MAX_VOTERS, len(normal))
    voter = jnp.arange(size) * jnp.maximum(-(-count // MAX_VOTERS), 1)
    row = jnp.where(voter < count, voter, 0)
    at, way = cloud.points[row], normal[row]
    by_view = sensor_votes(cloud, at, way, views.sensors[row])
    along = (views.normals[row] * way).sum(axis=1)
    by_view = jnp.clip(by_view + jnp.clip(along / GRAZING_COSINE, -1, 1), -1, 1)
    free = [free_distance(cloud, at, sign * way, CONE_SLOPE) for sign in (1, -1)]
    ratio = jnp.where(jnp.abs(by_view) < 1, jnp.clip(jnp.log(free[0] / free[1]), -1, 1), 0.0)
    weight = jnp.where(views.known, GEOMETRY_WEIGHT, 1.0)
    heard = jnp.where(voter < count, row, len(normal))
    vote = (
        (weight * FIELD_WEIGHT * jnp.clip(slope, -1, 1)).at[heard].add(weight * ratio + by_view, mode="drop")
    )
    return jnp.where(agreed(cloud, normal, jnp.where(cloud.mask, vote, 0.0)) < 0, -1.0, 1.0)


def sensor_votes(
    cloud: Cloud, points: Float[Array, "v 3"], normal: Float[Array, "v 3"], sensors: Float[Array, "v s 3"]
) -> Float[Array, " v"]:
    """−1 to 1: on which side of a point the sensors that may have seen it stand; blocked ones do not count."""
    ray = sensors - points[:, None]
    ray = jnp.nan_to_num(ray / jnp.maximum(jnp.linalg.norm(ray, axis=2, keepdims=True), 1e-12))
    side = jnp.clip((ray * normal[:, None]).sum(axis=2) / GRAZING_COSINE, -1, 1)
    disputed = (side > 0).any(axis=1) & (side < 0).any(axis=1)
    above = dataclasses.replace(cloud, lowest=jnp.full((), -jnp.inf))

    def unblocked(of_sensor: tuple[Array, Array]) -> Array:
        way, own = of_sensor
        asked = disputed & (own != 0)

        def seen() -> Array:
            return free_distance(above, points, way, LINE_OF_SIGHT_SLOPE) >= 1

        return jnp.where(asked & ~jax.lax.cond(asked.any(), seen, lambda: jnp.ones_like(asked)), 0.0, own)

    kept = jax.lax.map(unblocked, (jnp.moveaxis(ray, 1, 0), side.T))
    return jnp.clip(kept.sum(axis=0), -1, 1)


def free_distance(
    cloud: Cloud, points: Float[Array, "v 3"], direction: Float[Array, "v 3"], slope: float
) -> Float[Array, " v"]:
    """How far along `direction` the first other points lie, in a cone of that `slope`; 1 where none do.

    At the same distances as on the host. At which of them a point lies in the cone are the roots of a square equation:
    |p − x − s d| < slope · s.
    """
    steps = cloud.gap * STEP_RATIO ** np.arange(MAX_STEPS)
    narrowing = 1.0 - slope**2

    def first(some: tuple[Array, Array]) -> Array:
        x, d = some
        offset = [cloud.points[:, i] - x[:, i, None] for i in range(3)]
        along = sum(o * d[:, i, None] for i, o in enumerate(offset))
        inner = along**2 - narrowing * sum(o**2 for o in offset)
        root = jnp.sqrt(jnp.maximum(inner, 0.0))
        start, end = (along - root) / narrowing, (along + root) / narrowing
        step = jnp.ceil(jnp.log(jnp.maximum(start, 1e-9) / cloud.gap) / np.log(STEP_RATIO))
        step = jnp.maximum(step, 0.0)
        hit = cloud.mask & (inner > 0) & (cloud.gap * STEP_RATIO**step < end)
        return jnp.where(hit, step, MAX_STEPS).min(axis=1).astype(jnp.int32)

    at_once = min(RAYS_AT_ONCE, len(points))
    blocks = [jnp.pad(x, ((0, -len(points) % at_once), (0, 0))) for x in (points, direction)]
    found = jax.lax.map(first, tuple(x.reshape(-1, at_once, 3) for x in blocks)).reshape(-1)[: len(points)]
    below = points[:, 2, None] + steps * direction[:, 2, None] < cloud.lowest
    found = jnp.minimum(found, jnp.where(below.any(axis=1), below.argmax(axis=1), MAX_STEPS))
    distance = jnp.append(steps, 1.0)[found]
    return jnp.where(distance < MAX_DISTANCE, distance, 1.0)


def agreed(cloud: Cloud, normal: Points, vote: Values) -> Values:
    """Votes after they are weighed against those of neighbors, by conjugate gradients on the signed graph."""
    neighbor, d = (x[:, 1 : GRAPH_NEIGHBORS + 1] for x in (cloud.neighbors, cloud.distance))
    along = (at_rows(cloud.points, neighbor) - cloud.points[:, None]) / jnp.maximum(d, 1e-12)[..., None]
    other = at_rows(normal, neighbor)
    mirrored = other - 2 * (other * along).sum(axis=-1, keepdims=True) * along
    agree = (normal[:, None] * mirrored).sum(axis=-1)
    spacing = masked_median(d.ravel(), jnp.repeat(cloud.mask, d.shape[1]))
    weight = jnp.sign(agree) * jnp.abs(agree) ** CREASE_POWER
    weight *= 0.5 * jnp.exp(-0.5 * (d / jnp.maximum(2 * spacing, 1e-12)) ** 2) * cloud.mask[:, None]

    def summed(weight: Array, x: Values) -> Values:
        there = (weight * at_rows(x, neighbor)).sum(axis=1)
        return there.at[neighbor].add(weight * x[:, None])

    diagonal = VOTE_WEIGHT + summed(jnp.abs(weight), jnp.ones_like(vote))
    return conjugate_gradients(lambda x: diagonal * x - summed(weight, x), VOTE_WEIGHT * vote, vote)


def conjugate_gradients(times: Callable[[Values], Values], right: Values, start: Values) -> Values:
    """The solution of a positive definite system, as on the host."""
    residual = right - times(start)
    enough = TOLERANCE**2 * (right**2).sum()

    def unfinished(state: tuple[Array, ...]) -> Array:
        count, _, _, _, squared = state
        return (count < MAX_ITERATIONS) & (squared > enough)

    def step(state: tuple[Array, ...]) -> tuple[Array, ...]:
        count, x, residual, direction, squared = state
        moved = times(direction)
        length = squared / (direction * moved).sum()
        residual = residual - length * moved
        now = (residual**2).sum()
        return count + 1, x + length * direction, residual, residual + now / squared * direction, now

    state = (jnp.zeros((), jnp.int32), start, residual, residual, (residual**2).sum())
    return jax.lax.while_loop(unfinished, step, state)[1]
