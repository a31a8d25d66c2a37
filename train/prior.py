"""Trains the prior: `python -m train.prior --config configs/small.yaml --shards data/shards --out runs/small`.

Resumes from the newest checkpoint in `--out`, as if it had never stopped; ends after `--minutes`, leaving
checkpoint and weights. Runs on all devices, on a CPU on all cores; on several hosts, started once on each with
`--coordinator`.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from jax import Array
from jax.sharding import Mesh
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from more2_jax.config import load_config
from more2_jax.network.prior import Prior, save_prior
from train.run.batches import Batches, batches_of
from train.run.checkpoints import keep, open_checkpoints, resume
from train.run.devices import agreed, connect, device_a_core, device_mesh, everywhere, here, is_first
from train.run.journal import Journal
from train.run.memory import keep_freed_memory, memory_bytes
from train.run.pictures import held_out
from train.run.program import run
from train.run.settings import TrainingConfig, TrainingRun
from train.run.shape_mix import open_mix
from train.run.start import started_cold, started_warm
from train.run.state import TrainingState, initial_state, training_step
from train.run.validation import MOST_VALIDATED, total_score, validate
from train.shards.shards import Shapes

IN_PICTURE = 6  # held-out shapes


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What stays the same over a run."""

    training: TrainingConfig
    prior: Prior  # its settings and name; the weights at step 0
    mesh: Mesh
    batches: Batches
    val: Shapes
    out: Path
    deadline: float  # of time.monotonic()


def main(
    config: Path,
    shards: tuple[Path, ...],
    out: Path,
    minutes: float = math.inf,
    name: str = "",
    warm_start: str = "",
    val_shards: tuple[Path, ...] = (),
    resident_share: float = 0.4,
    coordinator: str = "",
    processes: int = 1,
    process: int = 0,
) -> None:
    """Trains until the configured number of steps, or for `minutes`.

    Args:
        config: YAML with `model` and `training`.
        shards: folders that `python -m train.prepare` wrote, or files of `train.tools.pack`; one that is named twice
            is drawn from twice as often.
        out: checkpoints, log.jsonl, curves, pictures, weights.npz (the last) and best.npz. Shared by all hosts.
        minutes: wall-clock budget.
        name: of the weights; by default the configuration file's.
        warm_start: weights to begin with in a fresh `--out`: name of shipped ones, or a file; the optimizer starts
            anew. The configuration's `model` has to be theirs.
        val_shards: folders of the validation shapes, which then stay the same while `shards` grow; by default `shards`.
        resident_share: of the memory (the device's, on accelerators) that shapes may take; larger collections are read
            from disk a batch at a time. The numbers are the same.
        coordinator: host:port of process 0, on a run of several processes.
        processes: how many there are.
        process: which of them this is.
    """
    deadline = time.monotonic() + 60 * minutes
    keep_freed_memory()
    settings, name = load_config(config, TrainingRun), name or config.stem
    device_a_core(settings.training.batch, coordinator)
    connect(coordinator, processes, process)
    first = started_warm(settings.model, warm_start, name) if warm_start else None
    sources = shards, val_shards or shards
    setting = prepared(settings, sources, out, deadline, name, first, resident_share * memory_bytes())
    train_and_save(setting)


def train_and_save(setting: Setting) -> None:
    """Resumes where the newest checkpoint is, trains, and leaves checkpoint and weights."""
    out = setting.out
    out.mkdir(parents=True, exist_ok=True)
    with open_checkpoints(out / "checkpoints") as manager:
        state = everywhere(setting.mesh, initial_state(setting.prior, setting.training))
        state = train_until(setting, *resume(manager, state), manager)
        manager.wait_until_finished()
    if is_first():
        save_prior(averaged(setting, state), out / "weights.npz")


def prepared(
    settings: TrainingRun,
    sources: tuple[Sequence[Path], Sequence[Path]],
    out: Path,
    deadline: float,
    name: str,
    warm: Prior | None,
    most_bytes: float,
) -> Setting:
    """Opens the shapes, of which `most_bytes` may be in memory, and initializes the weights if none are given.

    `sources`: of training shapes, and of validation shapes.
    """
    training = settings.training
    mesh = device_mesh(training.batch)
    train, val = open_mix(sources[0], "train"), open_mix(sources[1], "val")
    return Setting(
        training=training,
        prior=warm or started_cold(settings, train, name),
        mesh=mesh,
        batches=batches_of(train, training, mesh, most_bytes),
        val=jax.tree.map(jnp.asarray, val.read(range(min(MOST_VALIDATED, len(val))))),
        out=out,
        deadline=deadline,
    )


def averaged(setting: Setting, state: TrainingState) -> Prior:
    """The prior with the averaged weights, on this process' first device."""
    return dataclasses.replace(setting.prior, params=here(state.average))


def train_until(
    setting: Setting, state: TrainingState, step: int, manager: ocp.CheckpointManager
) -> TrainingState:
    """Steps until `steps` or the deadline; validates and checkpoints every so often and at the end."""
    config, began = setting.training, time.monotonic()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    book = Journal(setting.out, step) if is_first() else nullcontext()
    with Progress(*columns, disable=not is_first()) as progress, book as journal:
        task = progress.add_task("training", total=config.steps, completed=step)
        batches, terms = setting.batches(step), list[dict[str, Array]]()
        while step < config.steps and not agreed(time.monotonic() > setting.deadline):
            state, last = training_step(
                state,
                *next(batches),
                model=setting.prior.config,
                config=config,
                mesh=setting.mesh,
            )
            step += 1
            show(progress, task, terms)
            terms.append(last)
            if step % config.validate_every == 0:
                scores = validated(setting, state)
                if journal is not None:
                    report(journal, setting, state, step, time.monotonic() - began, means(terms), scores)
                keep(manager, step, state, scores["score"])
                terms, began = [], time.monotonic()
        keep(manager, step, state)
    return state


def show(progress: Progress, task: TaskID, terms: list[dict[str, Array]]) -> None:
    """Moves the bar on. Reads the step before, so that the devices never wait for the host."""
    if terms:
        progress.update(task, description=f"training, sdf {float(terms[-1]['sdf']):.4f}")
    progress.advance(task)


def means(terms: list[dict[str, Array]]) -> dict[str, float]:
    """Of every term over the steps."""
    host: list[dict[str, Any]] = jax.device_get(terms)
    return {name: float(np.mean([t[name] for t in host])) for name in host[0]}


def validated(setting: Setting, state: TrainingState) -> dict[str, float]:
    """Scores of the averaged weights. Every process computes them for itself: no process waits for another."""
    scores = validate(averaged(setting, state), setting.val, setting.training)
    return scores | {"score": total_score(scores)}


def report(
    journal: Journal,
    setting: Setting,
    state: TrainingState,
    step: int,
    seconds: float,
    train: dict[str, float],
    scores: dict[str, float],
) -> None:
    """Writes log, weights (the best ones too) and, every `picture_every` steps, a picture."""
    prior, config = averaged(setting, state), setting.training
    if scores["score"] > journal.best:
        save_prior(prior, setting.out / "best.npz")
    save_prior(prior, setting.out / "weights.npz")
    journal.write(step, journal.seconds + seconds, train, scores)
    if step // config.picture_every > (step - config.validate_every) // config.picture_every:
        journal.picture(step, held_out(prior, setting.val, config, IN_PICTURE))


if __name__ == "__main__":
    run(main)
