"""Do the readers survive damaged files? `python -m tests.fuzz.fuzz_readers --fixtures DIR --out runs/fuzz`

The fixtures, small true files of every format, are written by `PYTHONPATH=tests/support python -m dataset_writers DIR`.
Each mutation is read in a worker process. It may give a scan or a ValueError of one printable line, within the
time and memory allowed; anything else is a finding, kept with its files and replayed by `--format F --replay NUMBER`.
"""

from __future__ import annotations

import json
import multiprocessing
import resource
import shutil
import tempfile
import time
import warnings
import zlib
from collections import Counter
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from more2_jax.scans.read_scan import read_scan
from tests.fuzz.mutations import copy_fixture, damage
from train.run.program import run

FINE, REFUSED = "read", "refused"
SPARE = 4 << 30  # bytes of address space above the worker's own; a safety net far above --memory-mb
LONGEST_LINE = 1000


@dataclass
class Tally:
    """What the mutations of one format came to."""

    outcomes: Counter[str] = field(default_factory=Counter)
    findings: list[dict[str, str | int]] = field(default_factory=list)
    seconds: float = 0.0
    memory_mb: float = 0.0  # highest resident size of a worker above that before its first mutation


def main(
    fixtures: Path,
    out: Path,
    format: str = "all",
    mutations: int = 10_000,
    seed: int = 0,
    limit_s: float = 10.0,
    memory_mb: float = 1024.0,
    replay: int | None = None,
) -> None:
    """Damages every fixture in many ways and reads the result.

    Args:
        fixtures: folder with a folder a format, and in it one a case: the files and fixture.json.
        out: folder for findings and fuzz.json.
        format: one of the folders of `fixtures`, or all.
        mutations: a format.
        seed: of the mutations.
        limit_s: longest time one read may take.
        memory_mb: most memory that reading may add.
        replay: number of one mutation of --format, whose error is then shown whole.
    """
    formats = sorted(p.name for p in fixtures.iterdir() if p.is_dir()) if fixtures.is_dir() else []
    if not formats or format not in (*formats, "all"):
        raise ValueError(f"format {format!r}; {fixtures} has {', '.join(formats) or 'no fixtures'}")
    if replay is not None:
        scan, options, what = prepare(fixtures / format, seed, replay, out / "replay")
        print(f"{scan}: {what}")
        print(read_scan(scan, **options))
        return
    out.mkdir(parents=True, exist_ok=True)
    tallies = {}
    for name in formats if format == "all" else [format]:
        tallies[name] = fuzz(fixtures / name, mutations, seed, limit_s, memory_mb, out)
        (out / "fuzz.json").write_text(json.dumps({k: vars(t) for k, t in tallies.items()}, indent=1))
    Console(width=120).print(table_of(tallies))
    if found := sum(len(t.findings) for t in tallies.values()):
        raise ValueError(f"{found} findings, kept in {out}")


def prepare(fixture: Path, seed: int, number: int, folder: Path) -> tuple[Path, dict, str]:
    """Writes mutation `number` of a format to `folder`: the scan's path, options of read_scan, what was damaged."""
    rng = np.random.default_rng((seed, zlib.crc32(fixture.name.encode()), number))
    cases = sorted(p.parent for p in fixture.glob("*/fixture.json"))
    if not cases:
        raise ValueError(f"{fixture}: no fixtures; needed folders with a fixture.json")
    case = cases[rng.integers(len(cases))]
    options = json.loads((case / "fixture.json").read_text())
    copy_fixture(case, folder)
    scan, what = damage(folder, folder / options.pop("scan"), rng)
    if "masks" in options:
        options["masks"] = folder / options["masks"]
    return scan, options, what


def outcome_of(scan: Path, options: dict) -> str:
    """`read`, `refused`, or what went wrong."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            read_scan(scan, **options)
    except ValueError as error:
        text = str(error)
        clear = 0 < len(text) <= LONGEST_LINE and text.isprintable()
        return REFUSED if clear else f"unclear line: {text[:200]!r}"
    except (
        BaseException
    ) as error:  # also what native libraries raise past Exception: all of it is the finding
        return f"{type(error).__name__}: {str(error)[:200]}"
    return FINE


# --- the worker ---------------------------------------------------------------------------------------------------


def work(pipe: Connection, fixture: Path, seed: int, folder: Path) -> None:
    """Answers numbers of mutations with (outcome, what was damaged, peak resident MB)."""
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + SPARE, size + SPARE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    pipe.send(_peak_mb())
    while (number := pipe.recv()) is not None:
        scan, options, what = prepare(fixture, seed, number, folder)
        pipe.send((outcome_of(scan, options), what, _peak_mb()))


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


class Worker:
    """A process that reads mutations until one stops it."""

    def __init__(self, fixture: Path, seed: int, folder: Path) -> None:
        context = multiprocessing.get_context("fork")
        self.pipe, other = context.Pipe()
        self.process = context.Process(target=work, args=(other, fixture, seed, folder), daemon=True)
        self.process.start()
        other.close()
        self.base_mb = self.pipe.recv()

    def ask(self, number: int, limit_s: float) -> tuple[str, str, float]:
        """Outcome, what was damaged, and MB above the start."""
        self.pipe.send(number)
        if not self.pipe.poll(limit_s):
            self.process.kill()
            return f"no answer in {limit_s:g} s", "", 0.0
        try:
            outcome, what, peak = self.pipe.recv()
        except EOFError:
            self.process.join()
            return f"the process died ({self.process.exitcode})", "", 0.0
        return outcome, what, peak - self.base_mb

    def stop(self) -> None:
        """Ends the process, whatever it is doing."""
        self.process.kill()
        self.process.join()
        self.pipe.close()


def fuzz(fixture: Path, mutations: int, seed: int, limit_s: float, memory_mb: float, out: Path) -> Tally:
    """All mutations of one format, one after the other; a worker that fails is replaced."""
    tally, start = Tally(), time.perf_counter()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "mutated"
        worker = Worker(fixture, seed, folder)
        for number in range(mutations):
            outcome, what, extra_mb = worker.ask(number, limit_s)
            tally.memory_mb = max(tally.memory_mb, extra_mb)
            if outcome in (FINE, REFUSED) and extra_mb > memory_mb:
                outcome = f"took {extra_mb:.0f} MB"
            tally.outcomes[outcome if outcome in (FINE, REFUSED) else "finding"] += 1
            if outcome in (FINE, REFUSED):
                continue
            tally.findings.append({"number": number, "outcome": outcome, "what": what})
            kept = out / f"{fixture.name}_{number}"
            shutil.rmtree(kept, ignore_errors=True)
            shutil.copytree(folder, kept)
            worker.stop()
            worker = Worker(fixture, seed, folder)
        worker.stop()
    tally.seconds = time.perf_counter() - start
    return tally


def table_of(tallies: dict[str, Tally]) -> Table:
    """A row a format."""
    table = Table(
        "format", "mutations", "read", "refused in a clear line", "findings", "seconds", "most memory [MB]"
    )
    for name, t in tallies.items():
        count = sum(t.outcomes.values())
        numbers = (count, t.outcomes[FINE], t.outcomes[REFUSED], len(t.findings))
        table.add_row(name, *(f"{n}" for n in numbers), f"{t.seconds:.0f}", f"{t.memory_mb:.0f}")
    return table


if __name__ == "__main__":
    run(main)
