"""A function of every row of a batch, a few rows at a time where that keeps their arrays in a CPU's caches."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax

Tree = Any  # of arrays, with a leading axis of rows


def in_turn(one: Callable[[Tree], Tree], rows: Tree, at_once: int, devices: int = 1) -> Tree:
    """`jax.vmap(one)(rows)`; on CPUs `at_once` rows after the other, on each of `devices` that share the rows evenly.

    Where a whole batch's features outgrow the second-level cache, every pass over them waits for main memory.
    Accelerators have use for all rows together.
    """
    if jax.default_backend() != "cpu":
        return jax.vmap(one)(rows)
    shares = jax.tree.map(lambda x: x.reshape(devices, -1, *x.shape[1:]), rows)
    found = jax.vmap(lambda share: jax.lax.map(one, share, batch_size=at_once))(shares)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), found)
