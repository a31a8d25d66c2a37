"""Decoders for the decoding study: how a query meets the code, and what network follows.

All see the same frozen codes, in the published form: no look-up of observed points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jax import Array
from jaxtyping import Float, Int

from more2_jax.network.decoder import WeightNormDense
from more2_jax.network.prior import Prior, encode_ordered
from more2_jax.types import Embedding
from train.run.settings import TrainingConfig
from train.shards.losses import sdf_loss
from train.shards.sampling import TrainingSample, sample_batch
from train.shards.shards import Shapes

LEAST_LENGTH = 1e-6  # of a vector that becomes an axis


@dataclass(frozen=True)
class Variant:
    """One decoder of the study."""

    query: Literal["inner", "inv"]  # ⟨F_eqv, q⟩, or q in a frame that F_eqv spans
    network: Literal["deepsdf", "mlp"]  # weight normalization and a skip, or neither
    learns: Literal["distance", "occupancy"] = "distance"


VARIANTS: Mapping[str, Variant] = {
    "inner, DeepSDF": Variant("inner", "deepsdf"),
    "inner, MLP": Variant("inner", "mlp"),
    "inv, DeepSDF": Variant("inv", "deepsdf"),
    "inv, MLP": Variant("inv", "mlp"),
    "VN-ONet (inner, MLP, occupancy)": Variant("inner", "mlp", "occupancy"),
}


def frame_of(eqv: Float[Array, "3 c"], weights: Float[Array, "c 2"]) -> Float[Array, "3 3"]:
    """Right-handed orthonormal axes, as columns: two learned sums of the vectors, by Gram-Schmidt."""
    one, two = (eqv @ weights).T
    x = one / jnp.sqrt(one @ one + LEAST_LENGTH**2)
    rest = two - (two @ x) * x
    y = rest / jnp.sqrt(rest @ rest + LEAST_LENGTH**2)
    return jnp.stack([x, y, jnp.cross(x, y)], axis=1)


class QueryDecoder(nn.Module):
    """Value at points of one object: negative inside; canonical units of distance, or minus a logit of occupancy."""

    variant: Variant
    hidden: int
    layers: int
    skip_layer: int
    inv_gain: float
    eqv_gain: float

    @nn.compact
    def __call__(self, e: Embedding, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
        q = (points - e.center) / e.scale
        asked = self._asked(q, e.eqv)
        length = jnp.sqrt(jnp.sum(q * q, axis=-1, keepdims=True) + 1e-12)
        code = jnp.broadcast_to(self.inv_gain * e.inv, (len(q), len(e.inv)))
        x = jnp.concatenate([code, asked, length], axis=-1)
        if self.variant.network == "mlp":
            return self._mlp(x)
        return self._deepsdf(x)

    def _asked(self, q: Float[Array, "n 3"], eqv: Float[Array, "3 c"]) -> Float[Array, "n k"]:
        if self.variant.query == "inner":
            return self.eqv_gain * (q @ eqv)
        weights = self.param("frame", nn.initializers.normal(1.0), (eqv.shape[1], 2))
        return q @ frame_of(eqv, weights)

    def _mlp(self, x: Float[Array, "n i"]) -> Float[Array, " n"]:
        for _ in range(self.layers):
            x = nn.relu(nn.Dense(self.hidden)(x))
        return nn.Dense(1)(x)[:, 0]

    def _deepsdf(self, x: Float[Array, "n i"]) -> Float[Array, " n"]:
        h = x
        for i in range(self.layers):
            h = jnp.concatenate([h, x], axis=-1) if i == self.skip_layer else h
            kernel, bias = WeightNormDense(self.hidden)(h.shape[1])
            h = nn.relu(h @ kernel + bias)
        return jnp.tanh(nn.Dense(1)(h)[:, 0])


def decoder_of(prior: Prior, variant: Variant) -> QueryDecoder:
    """The variant at the prior's own width and depth."""
    d, c = prior.config.decoder, prior.config
    return QueryDecoder(variant, d.hidden, d.layers, d.skip_layer, c.inv_gain, c.eqv_gain)


def start(prior: Prior, codes: Embedding, seed: int) -> dict[str, Any]:
    """Random weights of every variant; `codes` is one object's."""
    point = jnp.zeros((1, 3))
    return {
        name: decoder_of(prior, v).init(jax.random.key(seed), codes, point) for name, v in VARIANTS.items()
    }


def optimizer(steps: int, learning_rate: float) -> optax.GradientTransformation:
    """The same for all."""
    return optax.chain(
        optax.clip_by_global_norm(1.0), optax.adam(optax.cosine_decay_schedule(learning_rate, steps))
    )


def loss_of(variant: Variant, values: Array, truth: Array, config: TrainingConfig) -> Float[Array, ""]:
    """The paper's loss of distances, or the cross-entropy of inside and outside."""
    if variant.learns == "distance":
        return sdf_loss(values, truth, config.near_surface)
    return optax.sigmoid_binary_cross_entropy(-values, truth < 0).mean()


@partial(jax.jit, static_argnames=("config", "points"))
def drawn(
    shapes: Shapes, rows: Int[Array, " r"], number: Int[Array, ""], *, config: TrainingConfig, points: int
) -> tuple[TrainingSample, Int[Array, " b"]]:
    """The batch of a step, and which shapes it is of: functions of (seed, number) alone."""
    index_key, sample_key = jax.random.split(jax.random.fold_in(jax.random.key(config.seed), number))
    index = rows[jax.random.randint(index_key, (config.batch,), 0, len(rows))]
    return sample_batch(sample_key, shapes, index, config, points), index


@partial(jax.jit, static_argnames=("config", "steps", "learning_rate"), donate_argnames=("weights", "states"))
def decoder_step(
    weights: dict[str, Any],
    states: dict[str, Any],
    prior: Prior,
    sample: TrainingSample,
    *,
    config: TrainingConfig,
    steps: int,
    learning_rate: float,
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Array]]:
    """One step of every variant on the same batch: new weights, new states, losses."""
    codes = jax.vmap(jax.vmap(partial(encode_ordered, prior)))(sample.points, sample.mask)
    losses = {}
    for name, variant in VARIANTS.items():
        grad = jax.value_and_grad(partial(batch_loss, prior, variant, codes, sample, config))
        losses[name], gradient = grad(weights[name])
        update, states[name] = optimizer(steps, learning_rate).update(gradient, states[name], weights[name])
        weights[name] = optax.apply_updates(weights[name], update)
    return weights, states, losses


def batch_loss(
    prior: Prior,
    variant: Variant,
    codes: Embedding,
    sample: TrainingSample,
    config: TrainingConfig,
    weights: Any,
) -> Float[Array, ""]:
    """One variant's loss over both clouds of every shape of a batch."""
    decoder = decoder_of(prior, variant)
    values = jax.vmap(jax.vmap(lambda e, q: decoder.apply(weights, e, q)))(codes, sample.queries)
    return loss_of(variant, jnp.asarray(values), sample.sdf, config)
