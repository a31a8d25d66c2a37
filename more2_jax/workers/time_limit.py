"""How long a worker may take for one task, by the clock on the wall."""

from __future__ import annotations

import time
from collections.abc import Hashable
from dataclasses import dataclass, field

from more2_jax.workers.dealing import Lost


@dataclass
class TimeLimit:
    """Which workers have begun a task, and when; without a limit (None) every one has any time."""

    seconds: float | None = None
    _began: dict[Hashable, float] = field(default_factory=dict)

    def begin(self, worker: Hashable) -> None:
        """The worker's time for a task counts from here."""
        self._began[worker] = time.monotonic()

    def end(self, worker: Hashable) -> None:
        """It has done it, or is gone."""
        self._began.pop(worker, None)

    def left_s(self) -> float | None:
        """Until the next worker is over it; None where none will be."""
        if self.seconds is None or not self._began:
            return None
        return max(0.0, min(self._began.values()) + self.seconds - time.monotonic())

    def over(self) -> list[Hashable]:
        """Those that are over it: they are to be ended."""
        if self.seconds is None:
            return []
        now = time.monotonic()
        return [w for w, began in self._began.items() if now - began >= self.seconds]

    def loss(self) -> Lost:
        """What is said of one that was over it."""
        assert self.seconds is not None
        return Lost(reason=f"not done within {self.seconds / 60:.3g} minutes")


def limit_of(minutes: float | None) -> float | None:
    """The option of the command line in seconds. Raises ValueError unless it is positive."""
    if minutes is not None and not minutes > 0:
        raise ValueError(f"--scene-minutes {minutes:g}; needed more than 0")
    return None if minutes is None else 60 * minutes
