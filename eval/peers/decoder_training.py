"""Trains encoder and decoder together, once for every decoder of the study, all with the same batches.

A step is one of all: whenever training stops, all have had equal steps of equal clouds and queries.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from jax import Array
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh
from jaxtyping import Float, Int
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from eval.peers.learned_decoders import VARIANTS, Variant, decoder_of
from more2_jax.config import PriorConfig
from more2_jax.network.prior import Prior, encode_ordered
from more2_jax.network.row_map import in_turn
from more2_jax.types import Embedding
from train.run.batches import Batches
from train.run.checkpoints import keep, open_checkpoints, resume
from train.run.settings import TrainingConfig
from train.run.state import TrainingState, draw, moved, optimizer
from train.shards.losses import AT_ONCE, code_terms, sdf_loss, sign_loss, weight_of
from train.shards.sampling import TrainingSample
from train.shards.shards import Shapes

Weights = Mapping[str, Any]  # `encoder` and `decoder`


@dataclass(frozen=True)
class Layout:
    """How the weights of a decoder and its encoder lie in one row: few arrays compile fast."""

    tree: Any  # its structure
    shapes: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, weights: Weights) -> Layout:
        """That of the weights as they are."""
        leaves, tree = jax.tree.flatten(weights)
        return cls(tree, tuple(jnp.shape(x) for x in leaves))

    def weights(self, row: Float[Array, " w"]) -> Weights:
        """The weights that a row holds."""
        ends = np.cumsum([math.prod(s) for s in self.shapes])[:-1]
        parts = [x.reshape(s) for x, s in zip(jnp.split(row, ends), self.shapes, strict=True)]
        return jax.tree.unflatten(self.tree, parts)


@dataclass(frozen=True, kw_only=True)
class Study:
    """What is the same for all decoders."""

    training: TrainingConfig
    start: Prior  # of which every decoder gets the encoder's random weights
    batches: Batches
    mesh: Mesh
    out: Path  # of checkpoints


def trained(study: Study, deadline: float) -> tuple[dict[str, Weights], int]:
    """The averaged weights of every decoder and its encoder, and after how many steps.

    Resumes from the newest checkpoint in `study.out`. Ends after all steps, or at `deadline`, of `time.monotonic()`.
    Raises ValueError if the checkpoint is of another configuration.
    """
    begun = {name: first_weights(study, variant) for name, variant in VARIANTS.items()}
    layouts = tuple(Layout.of(weights) for weights in begun.values())
    with open_checkpoints(study.out / "checkpoints") as manager:
        state, step = resume(manager, first_state(begun, study.training))
        state, step = trained_until(study, layouts, state, step, deadline, manager)
        manager.wait_until_finished()
    rows = zip(begun, layouts, strict=True)
    return {name: layout.weights(state.average[name]) for name, layout in rows}, step


def trained_until(
    study: Study,
    layouts: tuple[Layout, ...],
    state: TrainingState,
    step: int,
    deadline: float,
    manager: ocp.CheckpointManager,
) -> tuple[TrainingState, int]:
    """Steps until the configured number or the deadline, with a checkpoint every so often and at the end."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    config, batches, losses = study.training, study.batches(step), list[Array]()
    with Progress(*columns) as progress:
        task = progress.add_task(f"{len(VARIANTS)} decoders", total=config.steps, completed=step)
        while step < config.steps and time.monotonic() < deadline:
            state, last = study_step(
                state,
                *next(batches),
                layouts=layouts,
                model=study.start.config,
                config=config,
                mesh=study.mesh,
            )
            losses.append(last.block_until_ready())
            step += 1
            progress.advance(task)
            if step % config.validate_every == 0:
                means = jnp.stack(losses).mean(axis=0).tolist()
                told = ", ".join(f"{name} {mean:.4f}" for name, mean in zip(VARIANTS, means, strict=True))
                Console().print(f"{step} steps, sdf: {told}", highlight=False)
                keep(manager, step, state)
                losses = []
        keep(manager, step, state)
    return state, step


def first_weights(study: Study, variant: Variant) -> Weights:
    """The encoder of the start, and random weights of a decoder."""
    config = study.start.config
    cloud = jax.ShapeDtypeStruct((config.encoder.points, 3), jnp.float32)
    code = jax.eval_shape(
        partial(encode_ordered, study.start), cloud, jax.ShapeDtypeStruct(cloud.shape[:1], bool)
    )
    code = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), code)
    return {
        "encoder": study.start.params["encoder"],
        "decoder": decoder_weights(config, variant, code, study.training.seed),
    }


def decoder_weights(config: PriorConfig, variant: Variant, code: Embedding, seed: int) -> dict[str, Any]:
    """Random weights of one decoder; `code` is one object's."""
    start = jax.jit(decoder_of(config, variant).init)
    return start(jax.random.key(seed), code, jnp.zeros((1, 3)))["params"]


def first_state(begun: Mapping[str, Weights], config: TrainingConfig) -> TrainingState:
    """The state at step 0: of every decoder the weights, with those of its encoder, in one row."""
    rows = {name: ravel_pytree(weights)[0] for name, weights in begun.items()}
    return TrainingState(
        params=rows,
        average=jax.tree.map(jnp.copy, rows),  # a step takes the old state's memory
        optimizer={name: optimizer(config).init({name: row}) for name, row in rows.items()},
        step=jnp.zeros((), jnp.int32),
    )


@partial(jax.jit, static_argnames=("layouts", "model", "config", "mesh"), donate_argnames="state")
def study_step(
    state: TrainingState,
    shapes: Shapes,
    index: Int[Array, " b"],
    *,
    layouts: tuple[Layout, ...],
    model: PriorConfig,
    config: TrainingConfig,
    mesh: Mesh,
) -> tuple[TrainingState, Float[Array, " variants"]]:
    """One Adam step of every decoder and its encoder on shapes `index`: the new state, and errors of distances.

    Samples, terms, clipping, Adam and average are those of `train.prior`, of each decoder by itself.
    """
    sample, _ = draw(shapes, index, state.step, model, config, mesh)
    loss = partial(study_loss, layouts, model, config, sample, mesh)
    gradient, errors = jax.grad(loss, has_aux=True)(state.params)
    alone = {name: moved(of_one(state, name), {name: gradient[name]}, config) for name in VARIANTS}
    return TrainingState(
        params={name: s.params[name] for name, s in alone.items()},
        average={name: s.average[name] for name, s in alone.items()},
        optimizer={name: s.optimizer for name, s in alone.items()},
        step=state.step + 1,
    ), errors


def of_one(state: TrainingState, name: str) -> TrainingState:
    """What belongs to one decoder."""
    return TrainingState(
        params={name: state.params[name]},
        average={name: state.average[name]},
        optimizer=state.optimizer[name],
        step=state.step,
    )


def study_loss(
    layouts: tuple[Layout, ...],
    model: PriorConfig,
    config: TrainingConfig,
    sample: TrainingSample,
    mesh: Mesh,
    flat: Mapping[str, Float[Array, " w"]],
) -> tuple[Float[Array, ""], Float[Array, " variants"]]:
    """The sum of all decoders' losses of a batch, of which each has a part of the weights; and their first terms."""
    weights = {name: layout.weights(flat[name]) for name, layout in zip(VARIANTS, layouts, strict=True)}
    # Encoders differ in weights alone: as turns of one loop they compile once.
    encoders = jax.tree.map(lambda *x: jnp.stack(x), *(w["encoder"] for w in weights.values()))

    def one(shared: tuple[Any, Any], cloud: tuple[Array, ...]) -> tuple[Embedding, dict[str, Array]]:
        (encoders, weights), (points, mask, queries) = shared, cloud
        codes = jax.lax.map(
            lambda e: encode_ordered(Prior(params={"encoder": e}, config=model), points, mask, train=True),
            encoders,
        )
        return codes, {
            name: distances(model, variant, weights[name], jax.tree.map(lambda x, k=k: x[k], codes), queries)
            for k, (name, variant) in enumerate(VARIANTS.items())
        }

    clouds = (sample.points, sample.mask, sample.queries)
    rows = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), clouds)
    found = in_turn(one, (encoders, weights), rows, max(1, AT_ONCE // sample.points.shape[2]), mesh)
    codes, values = jax.tree.map(lambda x: x.reshape(-1, 2, *x.shape[1:]), found)
    terms = [
        terms_of(jax.tree.map(lambda x, k=k: x[:, :, k], codes), values[name], sample, config)
        for k, name in enumerate(VARIANTS)
    ]
    total = sum((weight_of(k, config) * v for of in terms for k, v in of.items()), jnp.zeros(()))
    return total, jnp.stack([of["sdf"] for of in terms])


def terms_of(
    codes: Embedding, values: Float[Array, "b 2 q"], sample: TrainingSample, config: TrainingConfig
) -> dict[str, Array]:
    """The loss terms of one decoder, as `train.prior` has them."""
    return code_terms(codes, config) | {
        "sdf": sdf_loss(values, sample.sdf, config.near_surface),
        "sign": sign_loss(values, sample.sdf, config.sign_width),
    }


def distances(
    config: PriorConfig, variant: Variant, weights: Weights, code: Embedding, points: Float[Array, "n 3"]
) -> Float[Array, " n"]:
    """What a decoder says of points of one object: canonical units, negative inside."""
    return decoder_of(config, variant).apply({"params": weights["decoder"]}, code, points)  # type: ignore[return-value]
