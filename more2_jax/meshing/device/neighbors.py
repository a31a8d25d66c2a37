"""The k nearest points of every point by brute force, and local outlier factors; as `geometry.outliers` by KD tree."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from more2_jax.geometry.outliers import NEIGHBORS
from more2_jax.geometry.points import FAR
from more2_jax.meshing.device.rows import at_rows

ROWS_AT_ONCE = 256  # of distances, 16 MB of 16,384 points

Points = Float[Array, "n 3"]
Mask = Bool[Array, " n"]


def nearest_neighbors(
    points: Points, mask: Mask, count: int
) -> tuple[Float[Array, "n count"], Int[Array, "n count"]]:
    """Distances and rows of the `count` nearest real points of every point, nearest first, itself among them.

    The distances have no gradient: `with_slopes` gives them one. Where there are fewer real points than `count`, some
    named are not real.
    """
    fixed = jax.lax.stop_gradient(points)

    def nearest(some: Float[Array, "r 3"]) -> tuple[Float[Array, "r k"], Int[Array, "r k"]]:
        squared = sum((some[:, None, i] - fixed[None, :, i]) ** 2 for i in range(3))
        closeness, index = jax.lax.top_k(-jnp.where(mask, squared, FAR), count)
        return jnp.sqrt(-closeness), index

    at_once = min(ROWS_AT_ONCE, len(points))
    blocks = jnp.pad(fixed, ((0, -len(points) % at_once), (0, 0))).reshape(-1, at_once, 3)
    distance, index = jax.lax.map(nearest, blocks)
    return distance.reshape(-1, count)[: len(points)], index.reshape(-1, count)[: len(points)]


def with_slopes(
    distance: Float[Array, "n k"], points: Points, neighbors: Int[Array, "n k"], mask: Mask
) -> Float[Array, "n k"]:
    """The distances of `nearest_neighbors` to the bit, with a gradient by the points; 0 of points at one place."""
    squared = ((points[:, None] - at_rows(points, neighbors)) ** 2).sum(axis=-1)
    told = (squared > 0) & mask[:, None] & at_rows(mask, neighbors)
    same = jnp.where(told, jnp.sqrt(jnp.where(told, squared, 1.0)), 0.0)
    return distance + (same - jax.lax.stop_gradient(same))


def inliers(points: Points, mask: Mask, max_factor: Float[Array, ""]) -> Mask:
    """The real points whose local outlier factor is `max_factor` or less; all where that is 0, or points are few."""
    distance, near = nearest_neighbors(points, mask, NEIGHBORS + 1)
    own = distance[:, 1:].mean(axis=1)
    around = at_rows(own, near[:, 1:]).mean(axis=1)
    factor = jnp.where(around > 0, own / jnp.where(around > 0, around, 1.0), 1.0)
    told = (max_factor > 0) & (mask.sum() > NEIGHBORS)
    return mask & (~told | (factor <= max_factor))
