"""What stages say while they run: an event to a function the caller passes, at the granularity of batches."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

Unit = Literal["objects", "pairs"]


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A part of the work that is timed and told of."""

    doing: str  # on the command line: "matching scan_1"
    title: str  # on the page
    unit: Unit = "objects"  # of what is counted


# In the order of the work; scene.json has their seconds by these names.
STAGES = {
    "encode": Stage(doing="encoding", title="Describing each object"),
    "match": Stage(doing="matching", title="Finding it again"),
    "register": Stage(doing="registering", title="Finding how it moved", unit="pairs"),
    "close": Stage(doing="fitting together", title="Fitting all scans of it together"),
    "joint": Stage(doing="optimizing jointly", title="Refining shape and pose"),
    "mesh": Stage(doing="meshing", title="Reconstructing surfaces"),
}


@dataclass(frozen=True, kw_only=True)
class Progress:
    """One stage began, came further, or ended."""

    event: Literal["started", "advanced", "finished"]
    stage: str  # one of `STAGES`
    scan: str | None  # name of the scan being added; None where the whole scene is worked on
    done: int
    total: int
    unit: Unit  # of `done` and `total`
    seconds: float  # since the stage began


Watcher = Callable[[Progress], None]


@contextmanager
def staged(
    timing: dict[str, float],
    progress: Watcher | None,
    stage: str,
    total: int,
    *,
    scan: str | None = None,
) -> Iterator[Callable[[int], None]]:
    """Adds the seconds of a stage to `timing` and tells `progress`; yields a function that takes what is done.

    A stage with nothing to do is not told of; one that raises has no end.
    """
    began = time.perf_counter()

    def tell(event: Literal["started", "advanced", "finished"], done: int) -> None:
        if progress is not None and total:
            seconds = time.perf_counter() - began
            progress(
                Progress(
                    event=event,
                    stage=stage,
                    scan=scan,
                    done=done,
                    total=total,
                    unit=STAGES[stage].unit,
                    seconds=seconds,
                )
            )

    tell("started", 0)
    yield lambda done: tell("advanced", done)
    timing[stage] = timing.get(stage, 0.0) + time.perf_counter() - began
    tell("finished", total)
