"""A program of this folder as data: what prepares it, what it makes of records; and how it is carried out.

In this process, in processes that stay alive, or by actors of a Ray cluster: the work is the same, and one process
writes what comes of it.
"""

from __future__ import annotations

import dataclasses
import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eval.harness.options import Options
from eval.harness.results import circumstances_now, finish
from eval.harness.run_folder import RunFolder, claim
from eval.harness.runs import Run, Work, keep, progress_bar, read_chunk, run_scenes, unfinished_chunks
from eval.harness.shards import write_part
from eval.scores.figures import Figure, Record, Row
from more2_jax.cli.session import keep_compiled_programs
from more2_jax.workers.dealing import Handler, Team, work_through
from more2_jax.workers.largest_first import largest_first
from more2_jax.workers.local import LocalTeam
from more2_jax.workers.ray_cluster import RayTeam
from more2_jax.workers.shares import shard_of
from more2_jax.workers.time_limit import limit_of
from train.run.program import run

Records = Mapping[str, Sequence[Record]]


@dataclass(frozen=True, kw_only=True)
class Summary:
    """What becomes of the records of all scenes: figures, also by group, and plots."""

    figures: Sequence[Figure]
    groups: Sequence[str] = ()
    plots: Callable[[Path, Records, Sequence[Row]], None] | None = None


@dataclass(frozen=True, kw_only=True)
class Program:
    """A program that goes over scenes: the `PROGRAM` of its module, which is named as its runs are."""

    settings: type[Options]
    prepare: Callable[[Any], tuple[Run, Work]]  # from options; touches no folder
    summary: Callable[[Any, float], Summary]  # from options, and the error below which a rotation is right


def program_named(name: str) -> Program:
    """The program `eval.name`. Raises ValueError if there is none."""
    try:
        return importlib.import_module(f"eval.{name}").PROGRAM
    except (ImportError, AttributeError) as error:
        raise ValueError(f"program {name!r}: none of eval that goes over scenes") from error


def run_program(main: Callable[..., Any]) -> None:
    """Runs `main` with the command line's arguments; bad input is one line and exit code 2."""
    if any(word.startswith("--distributed") for word in sys.argv[1:]):
        sys.exit("error: --distributed is gone: hosts take --shard i/n each, and eval.merge makes the tables")
    run(main)


def carry_out(program: Program, o: Options) -> None:
    """Works on this shard's scenes; with all scenes in one shard, writes the results too.

    Scenes that failed in a worker are told, one line each, and end the process with exit code 1.
    """
    shard, elsewhere = shard_of(o.shard), bool(o.workers) or o.ray is not None
    if limit_of(o.scene_minutes) and not elsewhere:
        raise ValueError(
            f"--scene-minutes {o.scene_minutes:g}; needed --workers or --ray, whose processes it ends"
        )
    current, work = program.prepare(o)
    claim(current.out, current.settings, fresh=o.fresh)
    write_part(current, o, circumstances_now())
    if elsewhere:
        run_elsewhere(current, o)
    else:
        run_scenes(current, o, work)
    write_part(current, o, circumstances_now())
    if shard.count == 1:
        conclude(program, current, o)
    else:
        left = sum(map(len, unfinished_chunks(current, o)))
        print(f"shard {shard}: {left} scenes left; `python -m eval.merge` makes the tables of all shards")


def conclude(
    program: Program, current: RunFolder, o: Options, circumstances: Mapping[str, Any] | None = None
) -> None:
    """Figures, tables and plots of all records in the folder."""
    summary, records = program.summary(o, current.right_deg), current.records()
    rows = finish(current, o, summary.figures, records, summary.groups, circumstances)
    if summary.plots is not None:
        summary.plots(current.out, records, rows)


@dataclass(frozen=True, kw_only=True)
class ChunkWorker:
    """Made in every worker: data, weights and compiled programs stay there over chunks."""

    program: str
    options: dict[str, Any]

    def __call__(self) -> Handler:
        """Names of a chunk's scenes → their records."""
        keep_compiled_programs()
        program = program_named(self.program)
        o = program.settings(**self.options)
        current, work = program.prepare(o)
        return lambda names: list(work(read_chunk(current, o, names)))


def team_of(maker: ChunkWorker, o: Options) -> Team:
    """Local processes, or actors of a cluster."""
    limit_s = limit_of(o.scene_minutes and o.scene_minutes * o.chunk)
    return (
        LocalTeam(maker, o.workers, limit_s) if o.ray is None else RayTeam(maker, o.ray, o.workers, limit_s)
    )


def run_elsewhere(current: Run, o: Options) -> None:
    """The chunks that are not finished, the largest first, by workers; what comes of them is written here."""
    todo = unfinished_chunks(current, o)
    if not todo:
        return
    maker = ChunkWorker(program=current.settings["program"], options=dataclasses.asdict(o))
    todo = largest_first(todo, lambda names: [file for n in names for file in current.data.files(n)])
    failed = 0
    with progress_bar() as bar:
        task = bar.add_task(current.settings["program"], total=sum(map(len, todo)))
        for outcome in work_through(todo, team_of(maker, o)):
            bar.advance(task, len(outcome.task))
            if outcome.answer.error:
                failed += len(outcome.task)
                print(f"error: {', '.join(outcome.task)}: {outcome.answer.error}", file=sys.stderr)
            else:
                keep(current, outcome.task, outcome.answer.value)
    if failed:
        print(f"error: {failed} scenes failed; the same command tries them again", file=sys.stderr)
        sys.exit(1)
