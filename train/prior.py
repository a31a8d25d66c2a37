"""Trains the prior: `python -m train.prior --config configs/small.yaml --shards data/shards --out runs/small`.

Resumes from the newest checkpoint in `--out`; stops after `--minutes`, leaving checkpoint and weights.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import orbax.checkpoint as ocp
from jax import Array
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from more2_jax.config import PriorConfig, TrainingConfig, TrainingRun, load_config
from more2_jax.data.sampling import sample_batch
from more2_jax.data.shards import Shapes, load_shapes
from more2_jax.losses import total_loss
from more2_jax.prior import Prior, encode_ordered, init_prior, save_prior
from more2_jax.types import pytree
from train.program import run
from train.validation import validate


@pytree
class TrainingState:
    """Everything that a checkpoint holds."""

    params: dict[str, Any]
    average: dict[str, Any]  # exponential moving average of the weights: what is shipped
    optimiser: Any
    step: Array


def main(
    config: Path, shards: tuple[Path, ...], out: Path, minutes: float = math.inf, name: str = ""
) -> None:
    """Trains until the configured number of steps, or for `minutes`.

    Args:
        config: YAML with `model` and `training`.
        shards: folders that `python -m train.prepare` wrote.
        out: checkpoints, log.jsonl and weights.npz.
        minutes: wall-clock budget.
        name: of the weights; by default the configuration file's.
    """
    deadline = time.monotonic() + 60 * minutes
    settings = load_config(config, TrainingRun)
    train, val = load_shapes(shards, "train"), load_shapes(shards, "val")
    model = calibrated(settings.model, settings.training, train)
    prior = init_prior(model, jax.random.key(settings.training.seed), name or config.stem)
    out.mkdir(parents=True, exist_ok=True)
    state = initial_state(prior, settings.training)
    options = ocp.CheckpointManagerOptions(max_to_keep=2)
    with ocp.CheckpointManager((out / "checkpoints").absolute(), options=options) as manager:
        if (latest := manager.latest_step()) is not None:
            state = manager.restore(latest, args=ocp.args.StandardRestore(state))
        state = train_until(deadline, state, prior, settings.training, train, val, out, manager)
    save_prior(dataclasses.replace(prior, params=state.average), out / "weights.npz")


def calibrated(model: PriorConfig, training: TrainingConfig, shapes: Shapes) -> PriorConfig:
    """Chooses the encoder's output constant so that F_s ≈ 1 at step 0 on the training shapes (METHOD 1)."""
    unit = dataclasses.replace(model, encoder=dataclasses.replace(model.encoder, output_scale=1.0))
    prior = init_prior(unit, jax.random.key(training.seed))
    index = jnp.arange(min(32, len(shapes.views)))
    sample = sample_batch(jax.random.key(training.seed), shapes, index, training, model.encoder.points)
    scale = jax.jit(jax.vmap(partial(encode_ordered, prior)))(sample.points[:, 0], sample.mask[:, 0]).scale
    constant = float(f"{1 / float(scale.mean()):.3g}")
    return dataclasses.replace(model, encoder=dataclasses.replace(model.encoder, output_scale=constant))


def optimiser(config: TrainingConfig) -> optax.GradientTransformation:
    """Adam with warm-up, cosine decay to 1 % and clipped gradients."""
    peak, warmup = config.learning_rate, config.warmup_steps
    rate = optax.warmup_cosine_decay_schedule(0.0, peak, warmup, config.steps, 0.01 * peak)
    adam = optax.chain(optax.clip_by_global_norm(config.clip), optax.adam(rate))
    return optax.apply_if_finite(adam, max_consecutive_errors=20)


def initial_state(prior: Prior, config: TrainingConfig) -> TrainingState:
    """The state at step 0."""
    return TrainingState(
        params=prior.params,
        average=jax.tree.map(jnp.copy, prior.params),
        optimiser=optimiser(config).init(prior.params),
        step=jnp.zeros((), jnp.int32),
    )


@partial(jax.jit, static_argnames="config", donate_argnames="state")
def training_step(
    state: TrainingState, prior: Prior, shapes: Shapes, config: TrainingConfig
) -> tuple[TrainingState, dict[str, Array]]:
    """One Adam step; what it sees depends on (seed, step) alone, so a resumed run sees the same."""
    key = jax.random.fold_in(jax.random.key(config.seed), state.step)
    index_key, sample_key, dropout_key = jax.random.split(key, 3)
    index = jax.random.randint(index_key, (config.batch,), 0, shapes.views.shape[0])
    sample = sample_batch(sample_key, shapes, index, config, prior.config.encoder.points)

    def loss(params: dict[str, Any]) -> tuple[Array, dict[str, Array]]:
        return total_loss(dataclasses.replace(prior, params=params), sample, config, dropout_key)

    gradient, terms = jax.grad(loss, has_aux=True)(state.params)
    updates, opt_state = optimiser(config).update(gradient, state.optimiser, state.params)
    params = optax.apply_updates(state.params, updates)
    # Early on the average follows quickly, or it would remember the random start for long.
    keep = jnp.minimum(config.ema, (1 + state.step) / (10 + state.step))
    average = jax.tree.map(lambda old, new: keep * old + (1 - keep) * new, state.average, params)
    terms = terms | {"gradient": optax.global_norm(gradient)}
    return TrainingState(params=params, average=average, optimiser=opt_state, step=state.step + 1), terms  # type: ignore[arg-type]


def train_until(
    deadline: float,
    state: TrainingState,
    prior: Prior,
    config: TrainingConfig,
    train: Shapes,
    val: Shapes,
    out: Path,
    manager: ocp.CheckpointManager,
) -> TrainingState:
    """Steps until `config.steps` or the deadline; validates and checkpoints every so often and at the end."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    began, sums, since = time.monotonic(), {}, 0
    with Progress(*columns) as progress:
        task = progress.add_task("training", total=config.steps, completed=int(state.step))
        while int(state.step) < config.steps and time.monotonic() < deadline:
            state, terms = training_step(state, prior, train, config)
            sums = {k: sums.get(k, 0.0) + float(v) for k, v in terms.items()}
            since += 1
            progress.update(task, advance=1, description=f"training, sdf {sums['sdf'] / since:.4f}")
            if int(state.step) % config.validate_every == 0:
                mean = {k: v / since for k, v in sums.items()}
                report(out, state, prior, config, val, mean, time.monotonic() - began)
                manager.save(int(state.step), args=ocp.args.StandardSave(state))
                sums, since = {}, 0
    if manager.latest_step() != int(state.step):
        manager.save(int(state.step), args=ocp.args.StandardSave(state))
    manager.wait_until_finished()
    return state


def report(
    out: Path,
    state: TrainingState,
    prior: Prior,
    config: TrainingConfig,
    val: Shapes,
    mean: dict[str, float],
    s: float,
) -> None:
    """Appends training means and validation scores to log.jsonl and writes the averaged weights."""
    averaged = dataclasses.replace(prior, params=state.average)
    scores = validate(averaged, val, config)
    line = {"step": int(state.step), "seconds": round(s, 1), "train": mean, "val": scores}
    with (out / "log.jsonl").open("a") as log:
        log.write(json.dumps(line, default=lambda x: np.asarray(x).item()) + "\n")
    save_prior(averaged, out / "weights.npz")


if __name__ == "__main__":
    run(main)
