"""Tasks dealt to workers one at a time: who is done gets the next; a task whose worker was killed is tried again."""

from __future__ import annotations

import traceback
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

TRIES = 2  # a task that took its worker with it may have been innocent once, hardly twice
Handler = Callable[[Any], Any]
Maker = Callable[[], Handler]  # called once in every worker: loads what all tasks share. Must pickle
FORESEEN = (ValueError, OSError)  # say in one line what is wrong; others are mistakes of ours


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What a worker says of a task: a value, or in one line why there is none."""

    value: Any = None
    error: str = ""


@dataclass(frozen=True, kw_only=True)
class Lost:
    """A worker is gone, and the task with it that it had."""

    reason: str


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """A task and what became of it; every task has exactly one."""

    task: Any
    answer: Answer
    tries: int


@runtime_checkable
class Team(Protocol):
    """Processes that work: how they are started, told and heard."""

    size: int

    def start(self) -> Hashable:
        """A new worker."""
        ...

    def give(self, worker: Any, task: Any) -> None:
        """A task for a worker that has none; that the worker is gone shows in `wait`."""
        ...

    def wait(self) -> list[tuple[Hashable, Answer | Lost]]:
        """Waits for some of the workers that have a task; what is heard may be nothing yet."""
        ...

    def dismiss(self, worker: Any) -> None:
        """Ends a worker that has no task."""
        ...

    def close(self) -> None:
        """Ends all workers, whatever they do."""
        ...


def work_through(tasks: Iterable[Any], team: Team) -> Iterator[Outcome]:
    """The outcome of every task, in the order in which they come; ends the team.

    What a task raises is its answer. A task whose worker is killed goes to the end of the queue, to another worker,
    until it has been tried `TRIES` times.
    """
    waiting = deque((task, 1) for task in tasks)
    having: dict[Hashable, tuple[Any, int]] = {}

    def deal(worker: Hashable) -> None:
        having[worker] = waiting.popleft()
        team.give(worker, having[worker][0])

    try:
        for _ in range(min(team.size, len(waiting))):
            deal(team.start())
        while having:
            for worker, answer in team.wait():
                task, tries = having.pop(worker)
                if isinstance(answer, Lost) and tries < TRIES:
                    waiting.append((task, tries + 1))
                elif isinstance(answer, Lost):
                    reason = f"its process ended {tries} times ({answer.reason})"
                    yield Outcome(task=task, answer=Answer(error=reason), tries=tries)
                else:
                    yield Outcome(task=task, answer=answer, tries=tries)
                if waiting:
                    deal(team.start() if isinstance(answer, Lost) else worker)
                elif isinstance(answer, Answer):
                    team.dismiss(worker)  # another that waits for room may start
    finally:
        team.close()


class Desk:
    """The side of a worker: makes its handler with the first task, answers tasks."""

    def __init__(self, maker: Maker) -> None:
        self.maker = maker
        self.handler: Handler | None = None

    def answer(self, task: Any) -> Answer:
        """The handler's value, or what it raised, in one line; of what nobody foresaw, the traceback is printed."""
        try:
            if self.handler is None:
                self.handler = self.maker()
            return Answer(value=self.handler(task))
        except FORESEEN as error:
            return Answer(error=" ".join(str(error).split()) or type(error).__name__)
        except Exception as error:
            traceback.print_exc()
            return Answer(error=" ".join(f"{type(error).__name__}: {error}".split()))
