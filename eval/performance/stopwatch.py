"""Seconds of work on a machine that may be shared: wall time, and the processor time of all threads beside it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

Clock = Float[np.ndarray, "2"]  # seconds of wall and of processor time; differences and shares of it, too


def clock() -> Clock:
    """Wall time, and the processor time of all threads so far."""
    return np.array([time.perf_counter(), time.process_time()])


def told(seconds: Clock) -> dict[str, float]:
    """What a record says of it."""
    return {"seconds": float(seconds[0]), "cpu_seconds": float(seconds[1])}


@dataclass(frozen=True)
class Seconds:
    """Of one or of the median run. Waiting for other programs counts in `wall` alone."""

    wall: float
    cpu: float


Job = Callable[[], Seconds]


def timed(work: Callable[[], Any]) -> Job:
    """A job that runs `work` once and waits for its arrays."""

    def job() -> Seconds:
        wall, cpu = time.perf_counter(), time.process_time()
        jax.block_until_ready(work())
        return Seconds(time.perf_counter() - wall, time.process_time() - cpu)

    return job


def median(runs: Sequence[Seconds]) -> Seconds:
    """Of wall and of processor time, each for itself."""
    return Seconds(float(np.median([r.wall for r in runs])), float(np.median([r.cpu for r in runs])))


def interleaved(jobs: Mapping[str, Job], repeats: int) -> dict[str, Seconds]:
    """Medians over `repeats` rounds, every job once a round, after one that does not count.

    In turn, so that what else the machine does meets all of them alike.
    """
    runs: dict[str, list[Seconds]] = {name: [] for name in jobs}
    for k in range(repeats + 1):
        for name, job in jobs.items():
            taken = job()
            if k:
                runs[name].append(taken)
    return {name: median(taken) for name, taken in runs.items()}
