"""How long JAX takes to make the programs of a command: `python -m eval.compile_seconds demo --out scene`.

Runs one `more2` command line in this process with an empty cache of compiled programs, and prints what every jitted
program took to trace, to lower and to compile, from JAX's own events, and what the whole process took. Programs of one
name are added up: more than one is compiled where shapes or settings differ.
"""

from __future__ import annotations

import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field

import jax
from rich.console import Console
from rich.table import Table

from more2_jax.cli.main import main as more2

STEPS = {
    "/jax/core/compile/jaxpr_trace_duration": "trace",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower",
    "/jax/core/compile/backend_compile_duration": "compile",
}


@dataclass
class Program:
    """Seconds by step, on the clock and of processor time, and how many programs share the name."""

    wall: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STEPS.values(), 0.0))
    cpu: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STEPS.values(), 0.0))
    compiled: int = 0


class Recorder:
    """Adds up JAX's events; a step's processor time is that of the whole process between its two events."""

    def __init__(self) -> None:
        self.programs: defaultdict[str, Program] = defaultdict(Program)
        self._began: dict[tuple[int, str, str], float] = {}

    def began(self, event: str, value: float | int, **kwargs: str | int) -> None:
        """What JAX calls at the start of a step."""
        if event in STEPS:
            self._began[threading.get_ident(), event, str(kwargs["fun_name"])] = time.process_time()

    def ended(self, event: str, duration_secs: float, **kwargs: str | int) -> None:
        """What JAX calls at the end of a step."""
        if event not in STEPS:
            return
        name, step = str(kwargs["fun_name"]), STEPS[event]
        began = self._began.pop((threading.get_ident(), event, name))
        program = self.programs[name.removeprefix("jit(").removeprefix("jit_").removesuffix(")")]
        program.wall[step] += duration_secs
        program.cpu[step] += time.process_time() - began
        program.compiled += step == "compile"


def measured(work: Callable[[], int]) -> tuple[int, dict[str, Program], float]:
    """What `work` returns, the programs that were made meanwhile, and all seconds of processor time so far."""
    recorder = Recorder()
    jax.monitoring.register_scalar_listener(recorder.began)
    jax.monitoring.register_event_duration_secs_listener(recorder.ended)
    try:
        code = work()
    finally:
        jax.monitoring.unregister_scalar_listener(recorder.began)
        jax.monitoring.unregister_event_duration_listener(recorder.ended)
    return code, dict(recorder.programs), time.process_time()


def table(programs: dict[str, Program], total: float) -> Table:
    """A row a program, the longest first, and their sum beside the whole process."""
    columns = Table(
        "program", "made", "trace s", "lower s", "compile s", "compile s, processor", "all s, processor"
    )
    rows = sorted(programs.items(), key=lambda item: -sum(item[1].cpu.values()))
    together = Program(compiled=sum(p.compiled for p in programs.values()))
    for _, p in rows:
        for step in STEPS.values():
            together.wall[step] += p.wall[step]
            together.cpu[step] += p.cpu[step]
    for name, p in [*rows, ("all programs", together)]:
        seconds = *p.wall.values(), p.cpu["compile"], sum(p.cpu.values())
        columns.add_row(name, str(p.compiled), *(f"{s:.2f}" for s in seconds))
    columns.add_row("the whole process", "", "", "", "", "", f"{total:.2f}")
    return columns


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as empty:
        jax.config.update("jax_compilation_cache_dir", empty)
        code, programs, total = measured(lambda: more2(sys.argv[1:]))
    Console(width=120).print(table(programs, total))
    sys.exit(code)
