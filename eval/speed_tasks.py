"""How fast the tasks are beside what one would use instead: `python -m eval.speed_tasks --data rooms/sparse404`.

Registration of pairs, one room, and many rooms, all in one run, in turn. The same command runs on an accelerator.
Peers have no mode for many rooms: theirs is one after the other. A row says nothing of how right the answers are;
`eval.registration` and `eval.end_to_end` do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from eval.data.flyingshape import open_flyingshape
from eval.data.truth import KnownScene
from eval.end_to_end import living_scene
from eval.harness.batched import register_all
from eval.harness.results import cost, write_rows
from eval.peers.end_to_end import NAME, combined, without_learning
from eval.peers.registration import Registrar, registrars
from eval.performance.stopwatch import Job, Seconds, interleaved, timed
from eval.registration import TruePair, ready_pairs, true_pairs
from eval.scores.figures import Row
from more2_jax.config import SceneConfig, preset
from more2_jax.network.prior import Prior, load_prior
from more2_jax.scene import run_scenes
from train.run.devices import cores
from train.run.program import run

OURS = "ours, robust"
ONE_BY_ONE = f"{OURS}, one at a time"


def main(
    data: Path,
    prior: str = "small",
    pairs: int = 64,
    scenes: int = 20,
    repeats: int = 3,
    out: Path | None = None,
) -> None:
    """Prints medians, and how many times ours they are.

    Args:
        data: rooms of `train.synthesize` with two scans or more.
        prior: name of shipped weights, or a file.
        pairs: true matches to register, of the first rooms.
        scenes: rooms, of two scans each; the row of one room is of the first.
        repeats: rounds; every competitor once a round, after one that does not count.
        out: folder of results.json.
    """
    known, weights = first_rooms(data, scenes), load_prior(prior)
    upright = open_flyingshape(data).upright
    config = preset("robust", upright=upright)
    chosen = list(islice((p for s in known for p in true_pairs(s, "first")), pairs))
    tasks = {
        "registration of the pairs": registration_jobs(weights, chosen, config),
        "one room": room_jobs(weights, known[:1], config),
        "all rooms": room_jobs(weights, known, config),
    }
    counts = dict(zip(tasks, (len(chosen), 1, len(known)), strict=True))
    jobs = {f"{task} / {who}": job for task, of_task in tasks.items() for who, job in of_task.items()}
    taken = {tuple(name.split(" / ")): seconds for name, seconds in interleaved(jobs, repeats).items()}
    Console().print(printed(ratios(taken), counts))
    if out is not None:
        rows = rows_of(taken, counts, len(known))
        write_rows(out, rows, program="speed_tasks", repeats=repeats, cores=cores(), prior=prior)


def rows_of(found: Mapping[tuple[str, ...], Seconds], counts: Mapping[str, int], rooms: int) -> list[Row]:
    """Wall and processor time of every task and competitor."""
    return [
        cost(task, who, value, "s", column, counts[task], rooms)
        for (task, who), taken in found.items()
        for column, value in (("wall", taken.wall), ("processor", taken.cpu))
    ]


def first_rooms(data: Path, count: int) -> list[KnownScene]:
    """The first two scans of the first rooms. ValueError if there are not so many."""
    benchmark = open_flyingshape(data)
    if len(benchmark.names) < count:
        raise ValueError(f"{data}: {len(benchmark.names)} rooms; needed {count}: see --scenes")
    return [benchmark.read(name).first_scans(2) for name in benchmark.names[:count]]


def registration_jobs(prior: Prior, pairs: Sequence[TruePair], config: SceneConfig) -> dict[str, Job]:
    """Ours from points to poses, encoding included, as one batch; peers pair by pair."""
    motion = "upright" if config.upright else "free"

    def ours() -> Any:
        ready, *_ = ready_pairs(pairs, prior, len(pairs))
        return register_all(prior, ready, config.registration, motion, len(pairs))

    def peer(register: Registrar) -> None:
        for p in pairs:
            register(*p.clouds, bool(config.upright))

    peers = {name: timed(partial(peer, register)) for name, register in registrars().items()}
    return {OURS: timed(ours), **peers}


def room_jobs(prior: Prior, rooms: Sequence[KnownScene], config: SceneConfig) -> dict[str, Job]:
    """From scans to matches, poses and meshes."""
    scans = [s.scans for s in rooms]
    jobs = {OURS: timed(lambda: run_scenes(prior, scans, config))}
    if len(rooms) > 1:
        jobs[ONE_BY_ONE] = timed(lambda: [living_scene(s, prior, config) for s in rooms])
    return jobs | {NAME: timed(lambda: [combined(s, without_learning(bool(config.upright))) for s in scans])}


def ratios(found: Mapping[tuple[str, ...], Seconds]) -> list[dict[str, Any]]:
    """A row a task and competitor."""
    rows = []
    for (task, who), taken in found.items():
        ours = found[task, OURS]
        row = {"task": task, "who": who, "wall_s": taken.wall, "cpu_s": taken.cpu}
        rows.append(row | {"wall_ratio": taken.wall / ours.wall, "cpu_ratio": taken.cpu / ours.cpu})
    return rows


def printed(rows: Sequence[Mapping[str, Any]], counts: Mapping[str, int]) -> Table:
    """The rows as a table, with how many pairs or rooms a task has."""
    table = Table("task", "who", "wall [s]", "processor [s]", "times ours, wall", "times ours, processor")
    for r in rows:
        numbers = (r["wall_s"], r["cpu_s"], r["wall_ratio"], r["cpu_ratio"])
        table.add_row(f"{r['task']} ({counts[r['task']]})", r["who"], *(f"{x:.2f}" for x in numbers))
    return table


if __name__ == "__main__":
    run(main)
