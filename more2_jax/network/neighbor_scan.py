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
    result: tuple[Tree, Tree] = _scan(edge, source, own, shared, each, index)  # pyright: ignore[reportAssignmentType]
    return result


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _scan(
    edge: Edge, source: Tree, own: Tree, shared: Tree, each: Tree, index: Int[Array, "n k"]
) -> tuple[Tree, Tree]:
    def step(total: Tree, at: tuple[Array, Tree]) -> tuple[Tree, Tree]:
        j, of_edge = at
        summand, kept = edge(_rows(source, j), own, shared, of_edge)
        return jax.tree.map(jnp.add, total, summand), kept

    shapes, _ = jax.eval_shape(
        edge, _rows(source, index[:, 0]), own, shared, jax.tree.map(lambda x: x[0], each)
    )
    zero = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    return jax.lax.scan(step, zero, (index.T, each))


def _rows(source: Tree, index: Int[Array, " n"]) -> Tree:
    return jax.tree.map(lambda x: x.at[index].get(mode=IN_BOUNDS), source)


def _forward(
    edge: Edge, source: Tree, own: Tree, shared: Tree, each: Tree, index: Array
) -> tuple[tuple[Tree, Tree], tuple[Tree, ...]]:
    return _scan(edge, source, own, shared, each, index), (source, own, shared, each, index)


def _backward(edge: Edge, kept: tuple[Tree, ...], gradient: tuple[Tree, Tree]) -> tuple[Tree, ...]:
    source, own, shared, each, index = kept
    of_sum, of_stack = gradient

    def step(total: Tree, at: tuple[Array, Tree, Tree]) -> tuple[Tree, Tree]:
        j, of_edge, of_kept = at
        _, pull = jax.vjp(edge, _rows(source, j), own, shared, of_edge)
        d_rows, d_own, d_shared, d_each = pull((of_sum, of_kept))
        d_source, *rest = total
        d_source = jax.tree.map(lambda whole, rows: whole.at[j].add(rows, mode=IN_BOUNDS), d_source, d_rows)
        return (d_source, *jax.tree.map(jnp.add, tuple(rest), (d_own, d_shared))), d_each

    zero = jax.tree.map(jnp.zeros_like, (source, own, shared))
    (d_source, d_own, d_shared), d_each = jax.lax.scan(step, zero, (index.T, each, of_stack))
    return d_source, d_own, d_shared, d_each, None


_scan.defvjp(_forward, _backward)
