"""Workers that are actors of a Ray cluster, one a GPU where it has any, else one a core."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Hashable
from typing import Any

from more2_jax.workers.dealing import Answer, Desk, Lost, Maker

ANSWER_S = 10.0  # for a cluster to answer at all


class RayTeam:
    """At most so many actors, and no more than the cluster has room for; 0 for as many as it has room for."""

    def __init__(self, maker: Maker, address: str, size: int = 0) -> None:
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

    def start(self) -> Hashable:
        """A new actor; where the cluster has no room it waits for some."""
        return self.actor.remote(self.maker)

    def give(self, worker: Any, task: Any) -> None:
        """A task for an actor that has none."""
        self.having[worker.answer.remote(task)] = worker

    def wait(self) -> list[tuple[Hashable, Answer | Lost]]:
        """Waits for at least one of the actors that have a task."""
        ready, _ = self.ray.wait(list(self.having), num_returns=1)
        heard: list[tuple[Hashable, Answer | Lost]] = []
        for reference in ready:
            worker = self.having.pop(reference)
            try:
                heard.append((worker, self.ray.get(reference)))
            except self.ray.exceptions.RayError as error:  # the actor, its node, or what it held
                heard.append((worker, Lost(reason=type(error).__name__)))
        return heard

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
