"""Decoders for the decoding study: how a query meets the code, and what network follows.

All are in the published form: no look-up of observed points, and no dropout.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from more2_jax.config import PriorConfig
from more2_jax.network.decoder import WeightNormDense
from more2_jax.types import Embedding

LEAST_LENGTH = 1e-6  # of a vector that becomes an axis


@dataclass(frozen=True)
class Variant:
    """One decoder of the study."""

    query: Literal["inner", "inv"]  # ⟨F_eqv, q⟩, or q in a frame that F_eqv spans
    network: Literal["deepsdf", "mlp"]  # weight normalization, a skip and tanh, or none of them


VARIANTS: Mapping[str, Variant] = {
    "inner, DeepSDF": Variant("inner", "deepsdf"),
    "inner, MLP": Variant("inner", "mlp"),
    "inv, DeepSDF": Variant("inv", "deepsdf"),
    "inv, MLP": Variant("inv", "mlp"),
}


def frame_of(eqv: Float[Array, "3 c"], weights: Float[Array, "c 2"]) -> Float[Array, "3 3"]:
    """Right-handed orthonormal axes, as columns: two learned sums of the vectors, by Gram-Schmidt."""
    one, two = (eqv @ weights).T
    x = one / jnp.sqrt(one @ one + LEAST_LENGTH**2)
    rest = two - (two @ x) * x
    y = rest / jnp.sqrt(rest @ rest + LEAST_LENGTH**2)
    return jnp.stack([x, y, jnp.cross(x, y)], axis=1)


class QueryDecoder(nn.Module):
    """Signed distance at points of one object, negative inside; canonical units."""

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
            x = nn.relu(nn.Dense(self.hidden, kernel_init=nn.initializers.he_normal())(x))
        return nn.Dense(1)(x)[:, 0]

    def _deepsdf(self, x: Float[Array, "n i"]) -> Float[Array, " n"]:
        h = x
        for i in range(self.layers):
            h = jnp.concatenate([h, x], axis=-1) if i == self.skip_layer else h
            kernel, bias = WeightNormDense(self.hidden)(h.shape[1])
            h = nn.relu(h @ kernel + bias)
        return jnp.tanh(nn.Dense(1)(h)[:, 0])


def decoder_of(config: PriorConfig, variant: Variant) -> QueryDecoder:
    """The variant at the width and depth that a prior's settings say."""
    d = config.decoder
    return QueryDecoder(variant, d.hidden, d.layers, d.skip_layer, config.inv_gain, config.eqv_gain)
