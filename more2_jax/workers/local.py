"""Workers that are processes of this machine, each at the other end of a pipe."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Hashable
from dataclasses import dataclass, field
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from more2_jax.workers.dealing import Answer, Desk, Lost, Maker
from more2_jax.workers.time_limit import TimeLimit

ENDING_S = 10.0  # for a process that was asked to end, or whose pipe broke


@dataclass(frozen=True)
class Begun:
    """What a worker says when it has taken a task: it has started, and its time counts from here."""


@dataclass
class LocalTeam:
    """So many processes at most; spawned, not forked: a fork after JAX has started threads may hang.

    A worker that takes longer than `limit_s` seconds for a task is killed, and lost.
    """

    maker: Maker
    size: int
    limit_s: float | None = None
    _workers: dict[int, tuple[BaseProcess, Any]] = field(default_factory=dict)
    _busy: set[int] = field(default_factory=set)
    _started: int = 0

    def __post_init__(self) -> None:
        self._limit = TimeLimit(self.limit_s)

    def start(self) -> Hashable:
        """A new process."""
        context = get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=serve, args=(theirs, self.maker), daemon=True)
        process.start()
        theirs.close()  # else its end would never be seen here
        self._started += 1
        self._workers[self._started] = (process, ours)
        return self._started

    def give(self, worker: int, task: Any) -> None:
        """A task for a worker that has none."""
        self._busy.add(worker)
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # `wait` tells
            self._workers[worker][1].send(task)

    def wait(self) -> list[tuple[Hashable, Answer | Lost]]:
        """Waits for some of the workers that have a task, or until one is over the limit."""
        ends = {self._workers[w][1]: w for w in self._busy}
        heard: list[tuple[Hashable, Answer | Lost]] = []
        for end in wait(list(ends), self._limit.left_s()):
            worker = ends[end]  # pyright: ignore[reportArgumentType]
            try:
                said = self._workers[worker][1].recv()
            except (EOFError, ConnectionResetError):
                said = Lost(reason=self._end_of(worker))
            if isinstance(said, Begun):
                self._limit.begin(worker)
            else:
                self._limit.end(worker)
                self._busy.discard(worker)
                heard.append((worker, said))
        return [*heard, *self._end_late()]

    def _end_late(self) -> list[tuple[Hashable, Answer | Lost]]:
        late = self._limit.over()
        for worker in late:
            self._limit.end(worker)
            self._busy.discard(worker)  # pyright: ignore[reportArgumentType]
            self._workers[worker][0].kill()  # pyright: ignore[reportArgumentType]
            self._end_of(worker)  # pyright: ignore[reportArgumentType]
        return [(worker, self._limit.loss()) for worker in late]

    def _end_of(self, worker: int) -> str:
        process, connection = self._workers.pop(worker)
        connection.close()
        process.join(ENDING_S)
        code = process.exitcode
        if code is not None and code < 0:
            return f"killed by {signal.Signals(-code).name}"
        return f"exit code {code}"

    def dismiss(self, worker: int) -> None:
        """Ends a worker that has no task: its pipe does."""
        process, connection = self._workers.pop(worker)
        connection.close()
        process.join(ENDING_S)

    def close(self) -> None:
        """Ends all workers, whatever they do."""
        for process, _ in self._workers.values():
            process.terminate()
        for process, connection in self._workers.values():
            connection.close()
            process.join(ENDING_S)
        self._workers.clear()


def serve(connection: Connection, maker: Maker) -> None:
    """What a worker does until its pipe ends. It ends with its parent too, even if that is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ctrl-C reaches the whole group; the parent decides
    threading.Thread(target=_end_with_parent, daemon=True).start()
    desk = Desk(maker)
    with contextlib.suppress(EOFError, ConnectionResetError, BrokenPipeError):
        while True:
            task = connection.recv()
            connection.send(Begun())
            connection.send(desk.answer(task))


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
