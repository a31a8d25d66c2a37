"""What a command says while it works: to the terminal, and to the living scene's run.log."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

WIDTH = 120  # of lines where no terminal says how wide it is


@dataclass
class Session:
    """Collects the log of one command; prints as it goes."""

    console: Console = field(
        default_factory=lambda: Console(width=None if sys.stdout.isatty() else WIDTH, highlight=False)
    )
    lines: list[str] = field(default_factory=list)

    def say(self, text: str) -> None:
        """Prints and logs."""
        self.console.print(text, markup=False, soft_wrap=True)
        self.log(text)

    def warn(self, text: str) -> None:
        """Prints on standard error and logs; the same warning only once."""
        line = f"warning: {one_line(text)}"
        if not any(logged.endswith(line) for logged in self.lines):
            print(line, file=sys.stderr, flush=True)
            self.log(line)

    def log(self, text: str) -> None:
        """Logs only."""
        self.lines += [f"{time.strftime('%Y-%m-%dT%H:%M:%S%z')} {line}" for line in text.splitlines()]

    def show(self, table: Table) -> None:
        """Prints a table."""
        self.console.print(table)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Shows on a terminal what is being done; logs it with its seconds once it is done."""
        began = time.perf_counter()
        if self.console.is_terminal:
            with self.console.status(escape(f"{name} …")):
                yield
        else:
            yield
        self.log(f"{name}: {time.perf_counter() - began:.2f} s")

    def text(self) -> str:
        """The log so far."""
        return "".join(f"{line}\n" for line in self.lines)


def one_line(text: object) -> str:
    """The text without line breaks."""
    return " ".join(str(text).split())


def cache_folder() -> Path:
    """Where compiled programs are kept: $MORE2_CACHE, or more2_jax in $XDG_CACHE_HOME or ~/.cache."""
    if own := os.environ.get("MORE2_CACHE"):
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "more2_jax"


def keep_compiled_programs() -> None:
    """Has JAX keep compiled programs between runs; a folder set through JAX's own settings stays."""
    import jax

    if jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
