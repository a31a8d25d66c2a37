"""Scenes side by side: the rows that do not fill a compiled call of their own scene fill one together with others'.

Every scene goes through the same code as a scene alone, in a thread of its own. Where that asks for rows in calls of a
fixed size (`row_map.chunked`), what is left over after the full calls waits for rows of other scenes that the same
program takes. A call is made as soon as it is full, or when every scene waits.
"""

from __future__ import annotations

import itertools
import os
import threading
from collections import defaultdict, deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

import jax
import numpy as np

from more2_jax.network.on_devices import Device, call_on, devices_at_hand

Tree = Any  # of arrays
Item = TypeVar("Item")
Result = TypeVar("Result")

SCENES_TOGETHER = 32  # that are held in memory side by side; each is some 30 MB with its scans


@dataclass(eq=False)
class Asked:
    """Rows of one scene that wait for a call, and what has been found of them."""

    function: Callable[[Tree], Tree]
    rows: Tree  # host arrays
    missing: int
    found: dict[int, Tree] = field(default_factory=dict)  # by the first row of each part
    error: BaseException | None = None


@dataclass(frozen=True)
class Part:
    """Rows `start` to `stop` of what was asked for."""

    asked: Asked
    start: int
    stop: int

    def rows(self) -> Tree:
        """Its rows alone."""
        return jax.tree.map(lambda x: x[self.start : self.stop], self.asked.rows)


class SharedCalls:
    """Calls that `scenes` scenes share, `together` held side by side, of which `at_once` work.

    The others wait for rows or for their turn.
    """

    def __init__(self, scenes: int, together: int, at_once: int) -> None:
        self._changed = threading.Condition()
        self._turns = at_once  # that are free
        self._queued = min(together, scenes)  # scenes that could go on, or begin, had they a turn
        self._later = scenes - self._queued  # that begin where another one has ended
        self._working = 0  # scenes between calls: they may still ask for rows
        self._pending: dict[tuple[Hashable, int], deque[Part]] = defaultdict(deque)
        self._devices = itertools.cycle(devices_at_hand())  # take calls in turn

    @contextmanager
    def scene(self) -> Iterator[None]:
        """A scene's turn begins and ends here; inside, `row_map.chunked` shares calls."""
        self._take_turn()
        token = CURRENT.set(self)
        try:
            yield
        finally:
            CURRENT.reset(token)
            with self._changed:
                if self._later:
                    self._later, self._queued = self._later - 1, self._queued + 1
            self._give_turn()

    def call(self, function: Callable[[Tree], Tree], size: int, rows: Tree) -> Tree:
        """`function` of fewer than `size` rows, in calls with rows of other scenes; waits for the result."""
        count = len(jax.tree.leaves(rows)[0])
        asked, key = Asked(function, rows, missing=count), (program_key(function, rows), size)
        with self._changed:
            self._pending[key].append(Part(asked, 0, count))
            full = self._take(key, size) if self._rows_pending(key) >= size else []
        if full:
            self._make(full, size)
        self._give_turn()
        while (work := self._awaited(asked)) is not None:
            self._make(*work)
            with self._changed:
                self._turns += 1
                self._changed.notify_all()
        self._take_turn()  # whoever made the last call has queued it
        if asked.error is not None:
            raise asked.error
        parts = [asked.found[start] for start in sorted(asked.found)]
        return jax.tree.map(lambda *x: np.concatenate(x), *parts)

    def _take_turn(self) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._turns)
            self._queued, self._turns, self._working = self._queued - 1, self._turns - 1, self._working + 1

    def _give_turn(self) -> None:
        with self._changed:
            self._turns, self._working = self._turns + 1, self._working - 1
            self._changed.notify_all()

    def _awaited(self, asked: Asked) -> tuple[list[Part], int] | None:
        """Waits until all that was asked for is found: None; or until all scenes wait: a call to make meanwhile."""

        def stuck() -> bool:
            idle = not self._working and not self._queued
            return bool(idle and self._turns and any(self._pending.values()))

        with self._changed:
            self._changed.wait_for(lambda: not asked.missing or stuck())
            if not asked.missing:
                return None
            key = max(self._pending, key=self._rows_pending)
            self._turns -= 1
            return self._take(key, key[1]), key[1]

    def _rows_pending(self, key: tuple[Hashable, int]) -> int:
        return sum(p.stop - p.start for p in self._pending[key])

    def _take(self, key: tuple[Hashable, int], size: int) -> list[Part]:
        """Parts of a call of `size` rows at most, in the order in which they were asked for."""
        waiting, taken, room = self._pending[key], list[Part](), size
        while waiting and room:
            part = waiting.popleft()
            end = min(part.stop, part.start + room)
            taken.append(Part(part.asked, part.start, end))
            if end < part.stop:
                waiting.appendleft(Part(part.asked, end, part.stop))
            room -= end - part.start
        return taken

    def _make(self, parts: Sequence[Part], size: int) -> None:
        """One call, filled up with its first row; its rows go to those who asked for them."""
        found, error = None, None
        try:
            found = called(parts[0].asked.function, size, [p.rows() for p in parts], next(self._devices))
        except BaseException as raised:  # every scene that has rows in it is told
            error = raised
        with self._changed:
            at = 0
            for p in parts:
                count = p.stop - p.start
                p.asked.missing -= count
                if error is None:
                    p.asked.found[p.start] = jax.tree.map(lambda x, a=at, n=count: x[a : a + n], found)
                p.asked.error = p.asked.error or error
                self._queued += not p.asked.missing
                at += count
            self._changed.notify_all()


CURRENT: ContextVar[SharedCalls | None] = ContextVar("shared calls of this thread's scene", default=None)


def called(function: Callable[[Tree], Tree], size: int, parts: Sequence[Tree], device: Device) -> Tree:
    """`function` of all rows of the parts, filled up to `size` with the first; host arrays."""
    count = sum(len(jax.tree.leaves(p)[0]) for p in parts)
    at = np.where(np.arange(size) < count, np.arange(size), 0)
    rows = jax.tree.map(lambda *x: np.concatenate(x)[at], *parts)
    return jax.device_get(call_on(device, function, rows))


def program_key(function: Callable[[Tree], Tree], rows: Tree) -> Hashable:
    """Equal for rows that one call can take: the same program, arguments, settings, and shapes of a row."""
    leaves, tree = jax.tree.flatten(rows)
    shapes = tuple((x.shape[1:], str(x.dtype)) for x in leaves)
    if isinstance(function, partial):
        program = (function.func, *map(id, function.args), *sorted(function.keywords.items()))
    else:
        program = (function,)
    return program, tree, shapes


def side_by_side(
    function: Callable[[Item], Result],
    scenes: Sequence[Item],
    at_once: int | None = None,
    together: int = SCENES_TOGETHER,
) -> list[Result]:
    """`function` of every scene, in order, with shared calls.

    `at_once` scenes work at the same time, by default as many as there are cores; `together` are held in memory. The
    first error of a scene is raised when all others are done.
    """
    if together < 1 or (at_once is not None and at_once < 1):
        raise ValueError(f"together {together}, at once {at_once}; needed 1 or more")
    if not scenes:
        return []
    together = min(together, len(scenes))
    shared = SharedCalls(len(scenes), together, at_once or os.cpu_count() or 1)

    def one(scene: Item) -> Result:
        with shared.scene():
            return function(scene)

    with ThreadPoolExecutor(together) as pool:
        waiting = [pool.submit(one, s) for s in scenes]
    return [w.result() for w in waiting]
