"""Rows that were computed before, while the same scans are compared again.

A scan is compared anew whenever its masks are mended, though most of its clouds are as they were. Rows that are equal
to the bit give the same result, so it is taken from memory.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from more2_jax.network.shared_calls import program_key

Tree = Any  # of arrays
Rows = Int[np.ndarray, " k"]

MOST_BYTES = 64_000_000  # of a function's results that are held; the oldest go first
DIGESTED_AT_ONCE = 64  # rows: what many rows share is held once a row while they are told apart


@dataclass(eq=False)
class RememberedRows:
    """Results of one program by what they were computed of."""

    most_bytes: int = MOST_BYTES
    size_bytes: int = 0
    found: OrderedDict[Hashable, Tree] = field(default_factory=OrderedDict)

    def keep(self, key: Hashable, result: Tree) -> None:
        """Holds one row's result, a copy; the oldest results go where there are too many."""
        self.found[key] = jax.tree.map(np.array, result)
        self.size_bytes += bytes_of(result)
        while self.size_bytes > self.most_bytes:
            _, oldest = self.found.popitem(last=False)
            self.size_bytes -= bytes_of(oldest)


@dataclass(eq=False)
class RememberedPrograms:
    """What is remembered of every program, apart: prepared clouds are large, and poses that a search found small."""

    most_bytes: int = MOST_BYTES
    rows: dict[Hashable, RememberedRows] = field(default_factory=dict)

    def of(self, program: Hashable) -> RememberedRows:
        """The results of a program."""
        return self.rows.setdefault(program, RememberedRows(self.most_bytes))


CURRENT: ContextVar[RememberedPrograms | None] = ContextVar("rows remembered in this context", default=None)


@contextmanager
def rows_remembered() -> Iterator[RememberedPrograms]:
    """Inside, `only_new` computes equal rows once."""
    programs = RememberedPrograms()
    token = CURRENT.set(programs)
    try:
        yield programs
    finally:
        CURRENT.reset(token)


def only_new(
    function: Callable[[Tree], Tree],
    count: int,
    taken: Callable[[Rows], Tree],
    computed: Callable[[Rows], Tree],
) -> Tree:
    """`computed` of all rows: of those that `function` was given before, from memory; host arrays.

    `taken` gives rows as `function` takes them, `computed` the results of some. Outside `rows_remembered` all are
    computed.
    """
    programs, every = CURRENT.get(), np.arange(count)
    if programs is None or not count:
        return computed(every)
    memory = programs.of(program_key(function, taken(every[:1])))
    keys = keys_of(count, taken)
    known = {key: memory.found[key] for key in keys if key in memory.found}
    new = np.array([n for n, key in enumerate(keys) if key not in known], int)
    results = computed(new) if len(new) else None
    for at, n in enumerate(new):
        memory.keep(keys[n], row_of(results, at))
    if len(new) == count:
        return results
    where = dict(zip(new.tolist(), range(len(new)), strict=True))
    every_row = [known[k] if k in known else row_of(results, where[n]) for n, k in enumerate(keys)]
    return jax.tree.map(lambda *x: np.concatenate(x), *every_row)


def once(function: Callable[..., Tree], told_by: Sequence[np.ndarray], *arguments: Any) -> Tree:
    """`function` of the arguments, host arrays; from memory where these arrays told it apart before."""
    programs = CURRENT.get()
    if programs is None:
        return function(*arguments)
    memory, key = programs.of(function), digest(told_by)
    if key in memory.found:
        return memory.found[key]
    result = function(*arguments)
    memory.keep(key, result)  # one too large to be held is not
    return result


def row_of(results: Tree, row: int) -> Tree:
    """The result of one row, with its leading axis."""
    return jax.tree.map(lambda x: np.asarray(x)[row : row + 1], results)


def keys_of(count: int, taken: Callable[[Rows], Tree]) -> list[bytes]:
    """What tells every row from all others that are not equal to it."""
    keys = list[bytes]()
    for start in range(0, count, DIGESTED_AT_ONCE):
        some = taken(np.arange(start, min(start + DIGESTED_AT_ONCE, count)))
        leaves = [np.asarray(x) for x in jax.tree.leaves(some)]
        keys += [digest([x[k : k + 1] for x in leaves]) for k in range(len(leaves[0]))]
    return keys


def digest(arrays: Sequence[np.ndarray]) -> bytes:
    """Equal for arrays of equal bytes."""
    hashed = hashlib.blake2b(digest_size=16)
    for x in arrays:
        hashed.update(np.ascontiguousarray(x).tobytes())
    return hashed.digest()


def bytes_of(tree: Tree) -> int:
    """Size of the arrays."""
    return sum(np.asarray(x).nbytes for x in jax.tree.leaves(tree))
