"""What a command says while it works: to the terminal, to the living scene's run.log, to a file of JSON lines."""

from __future__ import annotations

import json
import os
import sys
import time
from dataclasses import dataclass, field
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import TextIO

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bars
from rich.table import Table

from more2_jax.cli.damaged_programs import replace_damaged_programs
from more2_jax.cli.options import Reporting
from more2_jax.progress import STAGES, Progress

EMITTERS = "xla_cpu_use_fusion_emitters"  # a flag of XLA
KNOWS_EMITTERS = ("0.9.", "0.10.")  # versions of jaxlib
WIDTH = 120  # of lines where no terminal says how wide it is


def _console() -> Console:
    return Console(width=None if sys.stdout.isatty() else WIDTH, highlight=False)


@dataclass
class Session:
    """Collects the log of one command; prints as it goes. A context, which ends bars and the JSON file."""

    reporting: Reporting = field(default_factory=Reporting)
    console: Console = field(default_factory=_console)
    lines: list[str] = field(default_factory=list)
    steps: int | None = None  # stages to expect of the whole command, for the time left
    silent: bool = False  # logs alone, warnings too
    _saved: int = 0
    _file: TextIO | None = None
    _bars: Bars | None = None
    _whole: TaskID | None = None
    _task: TaskID | None = None

    def __enter__(self) -> Session:
        if self.reporting.log_json is not None:
            self._file = self.reporting.log_json.open("w", encoding="utf-8", buffering=1)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        if self._bars is not None:
            self._bars.stop()
            self._bars = None
        if error is not None:
            event = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
            self._write(event, text=one_line(error) or type(error).__name__)
        if self._file is not None:
            self._file.close()
            self._file = None

    @property
    def quiet(self) -> bool:
        """Whether it prints warnings and errors at most."""
        return self.silent or self.reporting.quiet

    def say(self, text: str) -> None:
        """Prints and logs."""
        if not self.quiet:
            self.console.print(text, markup=False, soft_wrap=True)
        self.log(text)

    def warn(self, text: str) -> None:
        """Prints on standard error and logs; the same warning only once."""
        line = f"warning: {one_line(text)}"
        if not any(logged.endswith(line) for logged in self.lines):
            if not self.silent:
                print(line, file=sys.stderr, flush=True)
            self._keep(line)
            self._write("warning", text=one_line(text))

    def log(self, text: str) -> None:
        """Logs only."""
        self._keep(text)
        self._write("message", text=text)

    def show(self, table: Table) -> None:
        """Prints a table."""
        if not self.quiet:
            self.console.print(table)

    def watch(self, p: Progress) -> None:
        """Takes what a stage tells: a bar on a terminal; elsewhere a line once the stage has ended."""
        about = f"{STAGES[p.stage].doing} {p.scan or 'the scene'}"
        if self.console.is_terminal and not self.quiet:
            self._draw(p, about)
        if p.event == "finished":
            line = f"{about}: {p.total} {p.unit}, {p.seconds:.1f} s"
            self._keep(line)
            if not (self.console.is_terminal or self.quiet):
                self.console.print(line, markup=False, soft_wrap=True)
        counts = {"stage": p.stage, "scan": p.scan, "done": p.done, "total": p.total, "unit": p.unit}
        self._write(p.event, **counts, seconds=round(p.seconds, 3))

    def _draw(self, p: Progress, about: str) -> None:
        if self._bars is None:
            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
            times = (TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
            self._bars = Bars(*columns, TextColumn("{task.fields[unit]}"), *times, console=self.console)
            self._bars.start()
            self._whole = self._bars.add_task("all", total=self.steps, unit="stages")
        if p.event == "started":
            self._task = self._bars.add_task(escape(about), total=p.total, unit=p.unit)
        elif self._task is not None:
            self._bars.update(self._task, completed=p.done)
        if p.event == "finished" and self._whole is not None:
            self._bars.advance(self._whole)

    def text(self) -> str:
        """The log so far."""
        return "".join(f"{line}\n" for line in self.lines)

    def unsaved(self) -> str:
        """The log since the last call: what a run.log that holds the rest still lacks."""
        new, self._saved = self.lines[self._saved :], len(self.lines)
        return "".join(f"{line}\n" for line in new)

    def _keep(self, text: str) -> None:
        self.lines += [f"{time.strftime('%Y-%m-%dT%H:%M:%S%z')} {line}" for line in text.splitlines()]

    def _write(self, event: str, **values: object) -> None:
        """One line of the JSON file, by assets/log.schema.json."""
        if self._file is not None:
            empty = dict.fromkeys(("stage", "scan", "done", "total", "unit", "seconds", "text"))
            stamp = datetime.now().astimezone().isoformat(timespec="milliseconds")
            self._file.write(json.dumps({"time": stamp, "event": event} | empty | values) + "\n")


def one_line(text: object) -> str:
    """The text without line breaks."""
    return " ".join(str(text).split())


def cache_folder() -> Path:
    """Where compiled programs are kept: $MORE2_CACHE, or more2_jax in $XDG_CACHE_HOME or ~/.cache."""
    if own := os.environ.get("MORE2_CACHE"):
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "more2_jax"


def compile_sooner() -> None:
    """Has XLA leave out, on CPUs, an emitter of fused loops that costs much time and gains these programs none.

    docs/developing/notebook/speed_scene.md has the figures. XLA stops at flags that it does not know: only
    versions that have it are told.
    """
    given = os.environ.get("XLA_FLAGS", "")
    if version("jaxlib").startswith(KNOWS_EMITTERS) and EMITTERS not in given:
        os.environ["XLA_FLAGS"] = f"{given} --{EMITTERS}=false".strip()


def keep_compiled_programs() -> None:
    """Has JAX keep compiled programs between runs, a folder set through JAX's own settings stays, and make them sooner.

    Call it before anything is compiled.
    """
    compile_sooner()
    import jax

    if jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    replace_damaged_programs()
