"""A function of every row of a batch: each device its share, on CPUs a few rows at a time to stay in the caches."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Int

from more2_jax.network.on_devices import call_on, devices_at_hand
from more2_jax.network.shared_calls import CURRENT

Tree = Any  # of arrays
Rows = Int[np.ndarray, " k"]
BLOCK = 256  # queries of a field: 768 points times so many are 0.8 MB
WIDER = 8  # times as many rows in a call of `chunked` on an accelerator
CALLS_AT_ONCE = 8  # on a CPU, of its cores; each call takes memory of its own


def in_turn(
    one: Callable[[Tree, Tree], Tree], shared: Tree, rows: Tree, at_once: int, mesh: Mesh | None = None
) -> Tree:
    """`one(shared, row)` of every row along the leading axis of `rows`, each device of `mesh` having its share.

    On CPUs `at_once` rows after the other: where a whole batch's features outgrow the second-level cache, every pass
    over them waits for main memory. Accelerators have use for all rows together. What a gradient is asked for stands
    in `shared` or `rows`, not in `one`. ValueError where the devices cannot share the rows evenly.
    """

    def some(shared: Tree, rows: Tree) -> Tree:
        if jax.default_backend() != "cpu":
            return jax.vmap(one, in_axes=(None, 0))(shared, rows)
        return jax.lax.map(lambda row: one(shared, row), rows, batch_size=at_once)

    if mesh is None or mesh.size == 1:
        return some(shared, rows)
    # Said outright: left to itself, the compiler has every device look for the neighbors of all rows.
    whole, split = PartitionSpec(), PartitionSpec(mesh.axis_names)
    share = jax.shard_map(some, mesh=mesh, in_specs=(whole, split), out_specs=split, check_vma=False)
    return share(shared, rows)


def in_blocks(function: Callable[[Array], Array], rows: Array, size: int = BLOCK) -> Array:
    """`function` of rows (leading axis n) that have nothing to do with one another, on CPUs `size` at a time.

    So what every layer makes of them stays in the caches; values and memory are those of a block where a gradient is
    asked for, too, which computes a block's values once more.
    """
    count = len(rows)
    if jax.default_backend() != "cpu" or count <= size:
        return function(rows)
    filled = jnp.pad(rows, ((0, -count % size), *((0, 0) for _ in rows.shape[1:])))
    one = jax.checkpoint(function, prevent_cse=False)
    found = jax.lax.map(one, filled.reshape(-1, size, *rows.shape[1:]))
    return found.reshape(-1, *found.shape[2:])[:count]


def chunked(function: Callable[[Tree], Tree], size: int, rows: Tree, wider: int = WIDER) -> Tree:
    """`function` of `rows` (leading axis b), in calls of `size` rows each: one compiled program whatever b is.

    Accelerators take `wider` times as many; several local devices (but for `jax.default_device`), or a CPU's cores,
    take calls in turn, side by side. What a `partial` closes over is brought to each device once.
    The last call is filled up with its first row; of no rows there is none. Where scenes are worked on side by side
    (`shared_calls`), the last call is made with rows of other scenes. Where anything is traced, the number of rows is
    part of a larger program anyway: they go in one call. Results are host arrays, but for traced ones.
    """
    if traced(rows):
        return function(rows)
    host = jax.tree.map(np.asarray, rows)
    count = len(jax.tree.leaves(host)[0])
    return chunked_at(function, size, count, lambda at: jax.tree.map(lambda x: x[at], host), wider)


def chunked_at(
    function: Callable[[Tree], Tree],
    size: int,
    count: int,
    taken: Callable[[Rows], Tree],
    wider: int = WIDER,
) -> Tree:
    """`chunked` of `count` rows that are made for every call anew: `taken` gives those at some places.

    What many rows share (an object that is part of many pairs) is so never held once a row.
    """
    size = size if jax.default_backend() == "cpu" else wider * size
    if not count:
        return _of_no_rows(function, taken(np.zeros(0, int)))
    shared, over = CURRENT.get(), count % size
    if shared is None or not over or traced(rest := taken(np.arange(count - over, count))):
        return _in_calls(function, size, count, taken)
    found = [_in_calls(function, size, count - over, taken)] if count > over else []
    found.append(shared.call(function, size, jax.tree.map(np.asarray, rest)))
    return jax.tree.map(lambda *x: np.concatenate(x), *found)


def _in_calls(function: Callable[[Tree], Tree], size: int, count: int, taken: Callable[[Rows], Tree]) -> Tree:
    """`chunked_at` of one row or more, without others' rows."""
    places = [_filled(start, size, count) for start in range(0, count, size)]
    devices, rows = devices_at_hand(), taken(places[0])
    first = call_on(devices[0], function, rows)
    if traced(first):  # by what the function closes over, or as part of a larger program
        return function(taken(np.arange(count)))
    calls = _on_devices if len(devices) > 1 else _on_cores if _cores() > 1 else _in_order
    *found, last = calls(function, taken, places[1:], first)
    last = jax.tree.map(lambda x: x[: count - places[-1][0]], last)
    return jax.tree.map(lambda *x: np.concatenate(x), *found, last) if found else last


def _filled(start: int, size: int, count: int) -> Rows:
    """The rows of the call that begins at `start`, filled up with its first."""
    at = np.arange(start, start + size)
    return np.where(at < count, at, start)


# Results of a first call, which is made, and of the others, in order, on the host.


def _in_order(
    function: Callable[[Tree], Tree], taken: Callable[[Rows], Tree], places: Sequence[Rows], first: Tree
) -> Iterator[Tree]:
    (device,) = devices_at_hand()
    yield jax.device_get(first)
    yield from (jax.device_get(call_on(device, function, taken(at))) for at in places)


def _on_devices(
    function: Callable[[Tree], Tree], taken: Callable[[Rows], Tree], places: Sequence[Rows], first: Tree
) -> Iterator[Tree]:
    """The devices take calls in turn, side by side."""
    devices, begun = devices_at_hand(), [first]
    for n, at in enumerate(places, start=1):
        begun.append(call_on(devices[n % len(devices)], function, taken(at)))
        if len(begun) == len(devices):
            yield from map(jax.device_get, begun)
            begun = []
    yield from map(jax.device_get, begun)


def _on_cores(
    function: Callable[[Tree], Tree], taken: Callable[[Rows], Tree], places: Sequence[Rows], first: Tree
) -> Iterator[Tree]:
    """The cores take calls in turn, side by side: programs that keep to the caches keep one core busy each."""
    wide = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    precision = jax.config.jax_default_matmul_precision  # pyright: ignore[reportAttributeAccessIssue]

    (device,) = devices_at_hand()

    def call(at: Rows) -> Tree:
        with jax.enable_x64(wide), jax.default_matmul_precision(precision):  # JAX keeps these by thread
            return jax.device_get(call_on(device, function, taken(at)))

    yield jax.device_get(first)  # compiled once
    if places:
        with ThreadPoolExecutor(min(_cores(), len(places))) as pool:
            yield from pool.map(call, places)


def _cores() -> int:
    """How many calls are made at a time: 1 on accelerators, and where scenes keep the cores busy already."""
    if jax.default_backend() != "cpu" or CURRENT.get() is not None:
        return 1
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(CALLS_AT_ONCE, allowed)


def _of_no_rows(function: Callable[[Tree], Tree], rows: Tree) -> Tree:
    """What `function` returns of no rows: nothing, in the shapes it has of one."""
    one = jax.tree.map(lambda x: jax.ShapeDtypeStruct((1, *x.shape[1:]), x.dtype), rows)
    return jax.tree.map(lambda x: np.zeros((0, *x.shape[1:]), x.dtype), jax.eval_shape(function, one))


def traced(tree: Tree) -> bool:
    """Whether any of the arrays is part of a program that JAX is tracing."""
    return any(isinstance(x, Tracer) for x in jax.tree.leaves(tree))
