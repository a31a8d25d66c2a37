"""Workers that are actors of a Ray cluster, one a GPU where it has any, else one a core."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Hashable
from typing import Any

from more2_jax.workers.dealing import Answer, Desk, Lost, Maker
from more2_jax.workers.time_limit import TimeLimit

ANSWER_S = 10.0  # for a cluster to answer at all


class RayTeam:
    """At most so many actors, and no more than the cluster has room for; 0 for as many as it has room for.

    An actor that takes longer than `limit_s` seconds for a task is killed, and lost. Its time counts from when it is
    up: where the cluster has no room, it waits as long as it takes.
    """

    def __init__(self, maker: Maker, address: str, size: int = 0, limit_s: float | None = None) -> None:
        """`address`: of a running cluster; "local" starts one here. Raises ValueError where there is none."""
        self.ray = connect(address)
        has = self.ray.cluster_resources()
        kind = "GPU" if has.get("GPU", 0) >= 1 else "CPU"
        room = int(has.get(kind, 0))
        self.size = min(size or room, room) or 1
        needs = {"num_gpus": 1} if kind == "GPU" else {"num_cpus": 1}
        self.actor = self.ray.remote(Desk).options(**needs, scheduling_strategy="SPREAD")
        self.maker = maker
        self.having: dict[Any, Hashable] = {}  # the reference of an answer to come → who gives it
        self.rising: dict[Any, Hashable] = {}  # the reference that tells that an actor is up → the actor
        self.limit = TimeLimit(limit_s)

    def start(self) -> Hashable:
        """A new actor; where the cluster has no room it waits for some."""
        worker = self.actor.remote(self.maker)
        if self.limit.seconds is not None:
            self.rising[worker.__ray_ready__.remote()] = worker
        return worker

    def give(self, worker: Any, task: Any) -> None:
        """A task for an actor that has none."""
        self.having[worker.answer.remote(task)] = worker
        if worker not in self.rising.values():
            self.limit.begin(worker)

    def wait(self) -> list[tuple[Hashable, Answer | Lost]]:
        """Waits for some of the actors that have a task, or until one is over the limit."""
        references = [*self.having, *self.rising]
        ready, _ = self.ray.wait(references, num_returns=1, timeout=self.limit.left_s())
        heard: list[tuple[Hashable, Answer | Lost]] = []
        for reference in ready:
            if reference in self.rising:
                self.limit.begin(self.rising.pop(reference))
                continue
            worker = self.having.pop(reference)
            try:
                heard.append((worker, self.ray.get(reference)))
            except self.ray.exceptions.RayError as error:  # the actor, its node, or what it held
                heard.append((worker, Lost(reason=type(error).__name__)))
            self._forget(worker)
        return [*heard, *self._end_late()]

    def _end_late(self) -> list[tuple[Hashable, Answer | Lost]]:
        late = self.limit.over()
        for worker in late:
            self.having = {r: w for r, w in self.having.items() if w != worker}
            self._forget(worker)
            self.ray.kill(worker)
        return [(worker, self.limit.loss()) for worker in late]

    def _forget(self, worker: Hashable) -> None:
        """Its task is done, or it is gone: no time runs for it."""
        self.limit.end(worker)
        self.rising = {r: w for r, w in self.rising.items() if w != worker}

    def dismiss(self, worker: Any) -> None:
        """Ends an actor that has no task."""
        self.ray.kill(worker)

    def close(self) -> None:
        """Ends all actors, whatever they do: they end with the connection."""
        self.ray.shutdown()


def connect(address: str) -> Any:
    """Ray, connected. Raises ValueError if it is not installed, or no cluster answers at `address`."""
    os.environ.setdefault("RAY_AUTH_MODE", "disabled")
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ValueError(
            "Ray is not installed; needed for a cluster: pip install 'more2-jax[cluster]'"
        ) from error
    _check_answers(address)
    try:
        ray.init(
            address=None if address == "local" else address,
            log_to_driver=False,
            include_dashboard=False,
            logging_level=logging.WARNING,
        )
    except (ConnectionError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(
            f"--ray {address}: no cluster there ({reason}); `ray start --head` starts one"
        ) from error
    return ray


def _check_answers(address: str) -> None:
    """Raises ValueError if nothing listens at host:port: Ray itself would try for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not port.isdigit():
        return
    try:
        socket.create_connection((host, int(port)), ANSWER_S).close()
    except OSError as error:
        raise ValueError(
            f"--ray {address}: no cluster there ({error.strerror or error}); `ray start --head` starts one"
        ) from error
