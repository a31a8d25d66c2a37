"""All programs on some data sets, then the page of all tables.

`python -m eval.everything --data data/flying_paper data/flying_sparse --out runs/all --scenes 4`
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from eval import ablations, accumulation, end_to_end, matching, reconstruction, registration, report
from eval.harness.options import Masks, Options
from more2_jax.config import PresetName
from train.run.program import run

Program = Literal["matching", "registration", "reconstruction", "end_to_end", "accumulation", "ablations"]
PROGRAMS: dict[Program, tuple[Any, type[Options]]] = {
    "matching": (matching.main, matching.Settings),
    "registration": (registration.main, registration.Settings),
    "reconstruction": (reconstruction.main, reconstruction.Settings),
    "end_to_end": (end_to_end.main, end_to_end.Settings),
    "accumulation": (accumulation.main, accumulation.Settings),
    "ablations": (ablations.main, ablations.Settings),
}


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What to run."""

    data: tuple[Path, ...]
    """Folders of data sets; each name becomes a folder of results."""
    out: Path
    """Folder of all results; stopped runs resume there."""
    dataset: Literal["flyingshape", "3rscan"] = "flyingshape"
    """What the folders hold."""
    presets: tuple[PresetName, ...] = ("robust",)
    """Settings of the method."""
    prior: str = "small"
    """Name of shipped weights, or a file."""
    scenes: int = 0
    """How many of each, from the first; 0 for all."""
    visits: int = 0
    """How many scans of each scene, from the first; 0 for all."""
    programs: tuple[Program, ...] = tuple(PROGRAMS)
    """Which."""
    scans: tuple[int, ...] = (1, 5)
    """Reconstruction after how many scans."""
    masks: tuple[Masks, ...] = ("true",)
    """End to end also through these masks."""
    samples: int = 20_000
    """Points on each surface."""
    classifier: Path | None = None
    """Weights of eval.peers.classifier, to be matched with too."""
    peers: bool = True
    """Also measure what one would use instead; only once, beside the first preset."""
    fresh: bool = False
    """Forget earlier results where settings or weights are others."""
    page: Path | None = None
    """Where the page of all tables goes; results_tables.md in `out` otherwise."""
    note: str = ""
    """A line about the circumstances."""


def main(settings: Annotated[Settings, tyro.conf.arg(name="")]) -> None:
    """Runs every program on every data set, one after the other."""
    s = settings
    began = time.perf_counter()
    for data in s.data:
        for preset in s.presets:
            for program in s.programs:
                for extra in variants(s, program):
                    one(s, data, preset, program, extra)
    report.main((s.out,), s.page or s.out / "results_tables.md", s.note)
    print(f"{time.perf_counter() - began:.0f} s")


def variants(s: Settings, program: Program) -> list[dict[str, Any]]:
    """What a program is run with: reconstruction by number of scans, end to end by masks."""
    if program == "reconstruction":
        return [{"scans": n} for n in s.scans]
    return [{"masks": m} for m in s.masks] if program == "end_to_end" else [{}]


def one(s: Settings, data: Path, preset: str, program: Program, extra: dict[str, Any]) -> None:
    """One run, in a folder of its own."""
    main, kind = PROGRAMS[program]
    name = "_".join([program, preset, *(str(v) for v in extra.values())])
    known = {f.name for f in dataclasses.fields(kind)}
    given: dict[str, Any] = {
        "data": data,
        "out": s.out / data.name / name,
        "dataset": s.dataset,
        "preset": preset,
        "prior": s.prior,
        "scenes": s.scenes,
        "visits": s.visits,
        "peers": s.peers and preset == s.presets[0],
        "fresh": s.fresh,
        "samples": s.samples,
        "classifier": s.classifier,
        **extra,
    }
    main(kind(**{k: v for k, v in given.items() if k in known}))


if __name__ == "__main__":
    run(main)
