"""One function over many inputs: on all cores of this machine, or on all machines of a Ray cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from types import TracebackType
from typing import Any, TypeVar

from more2_jax.workers.ray_cluster import connect

T = TypeVar("T")
R = TypeVar("R")


class Workers:
    """Worker processes as a context: `map` keeps the order, so results do not depend on who computed them."""

    def __init__(self, processes: int = 0, ray_address: str | None = None) -> None:
        """`processes` 0 means one a core; `ray_address` names a cluster instead ("local" starts one here).

        Raises ValueError if Ray is asked for and not installed.
        """
        self.pool: ProcessPoolExecutor | None = None
        self.ray: Any = None
        if ray_address is None:
            # Spawned, not forked: a fork after JAX has started threads may hang.
            self.pool = ProcessPoolExecutor(processes or os.cpu_count(), mp_context=get_context("spawn"))
        else:
            self.ray = connect(ray_address)

    def map(self, function: Callable[[T], R], items: Sequence[T]) -> list[R]:
        """`[function(x) for x in items]`, in parallel."""
        if self.pool is not None:
            return list(self.pool.map(function, items))
        task = self.ray.remote(function)
        return self.ray.get([task.remote(item) for item in items])

    def __enter__(self) -> Workers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.pool is not None:
            self.pool.shutdown(cancel_futures=True)
        else:
            self.ray.shutdown()
