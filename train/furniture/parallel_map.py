"""One function over many inputs: on all cores of this machine, or on all machines of a Ray cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from types import TracebackType
from typing import Any, TypeVar

from more2_jax.workers.ray_cluster import connect

T = TypeVar("T")
R = TypeVar("R")


class Workers:
    """Worker processes as a context: `map` keeps the order, so results do not depend on who computed them."""

    def __init__(self, processes: int = 0, ray_address: str | None = None, shared: Any = None) -> None:
        """`processes` 0 means one a core; `ray_address` names a cluster instead ("local" starts one here).

        `shared` goes to every process once, and stays there for `map_shared`. Raises ValueError if Ray is asked for
        and not installed.
        """
        self.pool: ProcessPoolExecutor | None = None
        self.ray: Any = None
        self.shared: Any = None  # the reference in the cluster
        if ray_address is None:
            # Spawned, not forked: a fork after JAX has started threads may hang.
            self.pool = ProcessPoolExecutor(
                processes or os.cpu_count(),
                mp_context=get_context("spawn"),
                initializer=_keep,
                initargs=(None, shared),
            )
        else:
            self.ray = connect(ray_address)
            self.shared = self.ray.put(shared)

    def map(self, function: Callable[[T], R], items: Sequence[T]) -> Iterator[R]:
        """`function(x)` for every x, in parallel and in order. Raises what a call of it raises."""
        if self.pool is not None:
            yield from self.pool.map(function, items)
            return
        task = self.ray.remote(_called)
        references = [task.remote(function, item) for item in items]
        try:
            for reference in references:
                yield self.ray.get(reference)
        except self.ray.exceptions.RayTaskError as error:  # it would tell the traceback of the other process
            raise error.cause from error

    def map_shared(self, function: Callable[[Any, T], R], items: Sequence[T]) -> Iterator[R]:
        """`function(shared, x)` for every x, as `map`. In one process it is the same `shared` every time."""
        # In a list a reference stays one: else the cluster would unpack it anew for every call.
        where = None if self.ray is None else [self.shared]
        return self.map(partial(_with_shared, function, where), items)

    def __enter__(self) -> Workers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.pool is not None:
            self.pool.shutdown(cancel_futures=True)
        else:
            self.ray.shutdown()


def _called(function: Callable[[T], R], item: T) -> R:
    """A function by name, which a cluster needs, that calls any other."""
    return function(item)


_kept: tuple[Any, Any] | None = None  # of this process: where what it shares came from, and that


def _keep(where: Any, shared: Any) -> None:
    global _kept
    _kept = (where, shared)


def _with_shared(function: Callable[[Any, T], R], where: Any, item: T) -> R:
    """Calls it with what this process keeps; a process of a cluster fetches that first."""
    if where is not None and (_kept is None or _kept[0] != where):
        import ray  # pyright: ignore[reportMissingImports]

        _keep(where, ray.get(where[0]))
    assert _kept is not None
    return function(_kept[1], item)
