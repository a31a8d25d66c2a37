"""Padded rows: real ones first, statistics of these alone, and where a mask is true."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int, Shaped


def real_first(mask: Bool[Array, " n"]) -> Int[Array, " n"]:
    """The order of rows in which the real ones come first, otherwise as they were."""
    return jnp.argsort(~mask, stable=True)


def masked_median(x: Float[Array, " n"], mask: Bool[Array, " n"]) -> Float[Array, ""]:
    """The median of the real rows, as NumPy has it; 0 of none."""
    ordered, count = jnp.sort(jnp.where(mask, x, jnp.inf)), mask.sum()
    middle = ordered[jnp.maximum(count - 1, 0) // 2], ordered[count // 2]
    return jnp.where(count > 0, 0.5 * (middle[0] + middle[1]), 0.0)


def evenly(count: Int[Array, ""], most: int) -> tuple[Int[Array, " most"], Bool[Array, " most"]]:
    """`most` places at even steps from the first of `count` rows to the last, and which of them are: all of fewer."""
    taken, at = jnp.minimum(count, most), jnp.arange(most)
    place = at * jnp.maximum(count - 1, 0) // jnp.maximum(taken - 1, 1)
    return jnp.where(at < taken, place, 0), at < taken


def true_places(mask: Bool[Array, " n"], most: int) -> tuple[Int[Array, " most"], Int[Array, " n"]]:
    """The first `most` places where a mask is true, those missing at its end; and how many are true up to each place.

    By search among the counts: many times faster than `jnp.nonzero`, which adds up by place.
    """
    counts = jnp.cumsum(mask, dtype=jnp.int32)
    found = jnp.searchsorted(counts, jnp.arange(1, most + 1, dtype=jnp.int32))
    return jnp.minimum(found, len(mask) - 1).astype(jnp.int32), counts


def at_rows(x: Shaped[Array, "n *_"], index: Int[Array, "*k"]) -> Shaped[Array, "*k *_"]:
    """Rows by numbers that are known to lie within."""
    return x.at[index].get(mode="promise_in_bounds")
