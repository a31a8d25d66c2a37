"""How fast training batches are made on this machine: `python -m eval.loading_speed --shards data/shards`.

A sample is two clouds of one shape with their queries, augmented, as one row of a training batch.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from more2_jax.config import load_config
from train.run.program import run
from train.run.settings import TrainingRun
from train.shards.loading import sample_records, training_records, training_samples
from train.shards.shards import open_shards


def main(
    shards: Path,
    config: Path = Path("configs/small.yaml"),
    threads: tuple[int, ...] = (1, 2),
    cores: int = 0,
    seconds: float = 10.0,
    batch: int = 32,
) -> None:
    """Prints samples and clouds a second: reading alone, sampling alone, and the loader with each count of threads.

    Args:
        shards: folder that `train.prepare` wrote.
        config: YAML with `model` and `training`; its clouds and queries are made.
        threads: loader threads; each count is pinned to as many cores, where the system can pin.
        cores: pin everything to so many cores instead; 0: as many as threads.
        seconds: measured for each figure, after a warm-up.
        batch: rows a batch.
    """
    check_positive(threads=min(threads, default=0), seconds=seconds, batch=batch, cores=cores + 1)
    settings = load_config(config, TrainingRun)
    training, points = settings.training, settings.model.encoder.points
    records = training_records(open_shards(shards, "train"), training, training.seed, batch)
    table = Table("stage", "cores", "samples/s", "clouds/s", "clouds/s a core")
    pinned, read = pin(cores or 1), dict(records[0] or {})

    def sample(_: int) -> None:
        sample_records(read, training.seed, training, points).sdf.block_until_ready()

    add_row(table, "reading", pinned, rate(lambda step: records[step], seconds, batch))
    add_row(table, "sampling", pinned, rate(sample, seconds, batch))
    for count in threads:
        pinned = pin(cores or count)
        loader = training_samples(
            shards, "train", training, points, training.seed, batch, threads=count, ahead=2 * count
        )
        speed = rate(lambda _, batches=loader: next(batches), seconds, batch, skip=4 * count)
        add_row(table, f"loader, {count} thread{'s' * (count > 1)}", pinned, speed)
        loader.close()
    Console().print(table)


def check_positive(**values: float) -> None:
    """Raises ValueError for a value that is not above 0."""
    for name, value in values.items():
        if value <= 0:
            raise ValueError(f"{name} {value}; needed more than 0")


def pin(cores: int) -> int:
    """Pins all threads of this process to the first `cores` it may use; returns how many it may use now."""
    if not hasattr(os, "sched_setaffinity"):
        return os.cpu_count() or 1
    chosen = set(sorted(ALLOWED)[:cores])
    for thread in os.listdir(f"/proc/{os.getpid()}/task"):
        os.sched_setaffinity(int(thread), chosen)
    return len(chosen)


ALLOWED = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()


def rate(work, seconds: float, batch: int, skip: int = 2) -> float:
    """Samples a second of `work(step)`, after `skip` calls."""
    for step in range(skip):
        work(step)
    done, began = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - began) < seconds:
        work(skip + done)
        done += 1
    return done * batch / elapsed


def add_row(table: Table, name: str, cores: int, speed: float) -> None:
    table.add_row(name, str(cores), f"{speed:.0f}", f"{2 * speed:.0f}", f"{2 * speed / cores:.0f}")


if __name__ == "__main__":
    run(main)
