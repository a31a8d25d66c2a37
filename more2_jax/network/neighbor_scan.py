"""Sums and maps over a point's neighbors, one neighbor at a time: exact, and several times faster on CPUs.

Written for all edges at once, a block's (n, k, 3, c) arrays pass through memory dozens of times, forward and
backward. Here a scan over the k neighbors keeps (n, 3, c) arrays in the cache, and its backward pass computes
every edge anew instead of storing it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Int

Tree = Any  # of arrays
IN_BOUNDS = (
    "promise_in_bounds"  # or every number fetched is compared with what stands in for rows that are not there
)
Edge = Callable[[Tree, Tree, Tree, Tree], tuple[Tree, Tree]]


def over_neighbors(
    edge: Edge, source: Tree, own: Tree, shared: Tree, each: Tree, index: Int[Array, "n k"]
) -> tuple[Tree, Tree]:
    """`edge(source[index[:, j]], own, shared, each[j])` for j = 0 … k − 1; it returns (a, b), all (n, …).

    `source` has a row a point to choose from, `own` a row a point, `shared` is the same for all, `each` has a
    leading axis of k. Returns the sum of the a and the stack (k, n, …) of the b; either may be empty.
    """

    # Inside a scan nothing merges the second computation with the first: no barriers are needed to keep them apart.
    @partial(jax.checkpoint, prevent_cse=False)
    def computed_anew(source: Tree, own: Tree, shared: Tree, of_edge: Tree, j: Array) -> tuple[Tree, Tree]:
        return edge(_rows(source, j), own, shared, of_edge)

    def step(total: Tree, at: tuple[Array, Tree]) -> tuple[Tree, Tree]:
        j, of_edge = at
        summand, kept = computed_anew(source, own, shared, of_edge, j)
        return jax.tree.map(jnp.add, total, summand), kept

    shapes, _ = jax.eval_shape(
        edge, _rows(source, index[:, 0]), own, shared, jax.tree.map(lambda x: x[0], each)
    )
    zero = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    return jax.lax.scan(step, zero, (index.T, each))


def _rows(source: Tree, index: Int[Array, " n"]) -> Tree:
    return jax.tree.map(lambda x: x.at[index].get(mode=IN_BOUNDS), source)
