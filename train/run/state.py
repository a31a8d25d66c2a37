"""What a training run remembers from step to step, and how one step changes it."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jax.sharding import Mesh
from jaxtyping import Int

from more2_jax.config import PriorConfig
from more2_jax.network.prior import Prior, points_read
from more2_jax.types import pytree
from train.run.devices import by_rows
from train.run.schedule import learning_rate
from train.run.settings import TrainingConfig
from train.shards.losses import total_loss
from train.shards.sampling import TrainingSample, sample_batch
from train.shards.shards import Shapes


@pytree
class TrainingState:
    """Everything that a checkpoint holds."""

    params: dict[str, Any]
    average: dict[str, Any]  # exponential moving average of the weights: what is shipped
    optimizer: Any
    step: Array


def optimizer(config: TrainingConfig) -> optax.GradientTransformation:
    """Adam with clipped gradients; a step whose gradient is not finite is left out."""
    adam = optax.chain(optax.clip_by_global_norm(config.clip), optax.adam(learning_rate(config)))
    return optax.apply_if_finite(adam, max_consecutive_errors=20)


def initial_state(prior: Prior, config: TrainingConfig) -> TrainingState:
    """The state at step 0."""
    return TrainingState(
        params=jax.tree.map(jnp.copy, prior.params),  # a step takes the old state's memory
        average=jax.tree.map(jnp.copy, prior.params),
        optimizer=optimizer(config).init(trained(prior.params, config)),
        step=jnp.zeros((), jnp.int32),
    )


def trained(params: dict[str, Any], config: TrainingConfig) -> dict[str, Any]:
    """The weights that steps change."""
    return params if config.train == "all" else {k: v for k, v in params.items() if k != "encoder"}


def draw(
    shapes: Shapes,
    index: Int[Array, " b"],
    step: Array,
    model: PriorConfig,
    config: TrainingConfig,
    mesh: Mesh,
) -> tuple[TrainingSample, Array]:
    """Samples of shapes `index` and the key of the step's dropout: the same whatever the devices."""
    key = jax.random.fold_in(jax.random.key(config.seed), step)
    sample_key, dropout_key = jax.random.split(key)
    sample = sample_batch(sample_key, shapes, index, config, points_read(model))
    return jax.lax.with_sharding_constraint(sample, by_rows(mesh)), dropout_key


@partial(jax.jit, static_argnames=("model", "config", "mesh"), donate_argnames="state")
def training_step(
    state: TrainingState,
    shapes: Shapes,
    index: Int[Array, " b"],
    *,
    model: PriorConfig,
    config: TrainingConfig,
    mesh: Mesh,
) -> tuple[TrainingState, dict[str, Array]]:
    """One Adam step on shapes `index`; returns the new state and the loss terms.

    The loss is that of the whole batch: JAX splits it over the rows of `mesh` and exchanges what rows share,
    which is the codes of the contrast term and the gradient.
    """
    sample, dropout_key = draw(shapes, index, state.step, model, config, mesh)

    # Of weights that stay nothing is differentiated, which for the encoder is most of a step.
    def loss(params: dict[str, Any]) -> tuple[Array, dict[str, Array]]:
        prior = Prior(params=state.params | params, config=model)
        return total_loss(prior, sample, config, dropout_key, mesh)

    gradient, terms = jax.grad(loss, has_aux=True)(trained(state.params, config))
    return moved(state, gradient, config), terms | {"gradient": optax.global_norm(gradient)}


def moved(state: TrainingState, gradient: dict[str, Any], config: TrainingConfig) -> TrainingState:
    """The state after one step of Adam along a gradient of the weights that steps change."""
    before, average = trained(state.params, config), trained(state.average, config)
    updates, opt_state = optimizer(config).update(gradient, state.optimizer, before)
    params: dict[str, Any] = optax.apply_updates(before, updates)  # pyright: ignore[reportAssignmentType]
    # Early on the average follows quickly, or it would remember the random start for long.
    keep = jnp.minimum(config.ema, (1 + state.step) / (10 + state.step))
    average = jax.tree.map(lambda old, new: keep * old + (1 - keep) * new, average, params)
    return dataclasses.replace(
        state,
        params=state.params | params,
        average=state.average | average,
        optimizer=opt_state,
        step=state.step + 1,
    )
