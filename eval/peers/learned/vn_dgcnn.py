"""VN-DGCNN (Deng et al., Vector Neurons, ICCV 2021): graph convolutions on vectors, and what of them does not turn.

Matching is by the cosine of an invariant code, trained by contrast: two partial clouds of one shape are alike.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from eval.peers.learned.clouds import centered
from more2_jax.config import EncoderConfig
from more2_jax.network.encoder import FirstBlock, LinearBlock
from more2_jax.network.vector_neurons import VNLA, channel_products, kernel_init, linear, masked_mean, norm
from train.shards.losses import contrast_loss
from train.shards.sampling import TrainingSample

GRAPH = EncoderConfig(widths=(16, 16, 32, 32), linear_blocks=4, neighbors=8, code=32, points=256)
THINNED_AT, THINNED_BY = 1, 2  # the published network keeps all points at every block
TEMPERATURE = 0.07  # of the contrast, as in training the prior
CODE = 96  # numbers a cloud is matched by
FAR = 1e9


class GraphVectors(nn.Module):
    """Edge convolutions on vectors; features of all blocks side by side, mixed, a row a point that is left."""

    config: EncoderConfig = GRAPH

    @nn.compact
    def __call__(
        self, points: Float[Array, "n 3"], mask: Bool[Array, " n"]
    ) -> tuple[Float[Array, "m 3 c"], Bool[Array, " m"]]:
        c = self.config
        features = FirstBlock(c)(points, mask)
        levels = [features]
        for i, width in enumerate(c.widths[1:], start=1):
            keep = len(features) // (THINNED_BY if i == THINNED_AT else 1)
            features = LinearBlock(c, width)(features, mask, features[:keep])
            mask = mask[:keep]
            levels.append(features)
        joined = jnp.concatenate([x[: len(features)] for x in levels], axis=-1)
        return VNLA(c.code, c.leak)(joined), mask


class Invariants(nn.Module):
    """⟨vector, axis⟩ for three learned axes that turn along (VNStdFeature): numbers that do not turn."""

    leak: float = GRAPH.leak

    @nn.compact
    def __call__(self, x: Float[Array, "3 c"]) -> Float[Array, " k"]:
        y = VNLA(x.shape[-1] // 2, self.leak)(x)
        axes = linear(y, self.param("axes", kernel_init, (y.shape[-1], 3)))
        return (x.T @ axes).reshape(-1)


class VNDGCNN(nn.Module):
    """A cloud to a unit code that neither turning, moving nor scaling it changes."""

    config: EncoderConfig = GRAPH

    @nn.compact
    def __call__(self, points: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Float[Array, " code"]:
        cloud = centered(points, mask)
        vectors, mask = GraphVectors(self.config)(cloud.points, cloud.mask)
        whole = jnp.broadcast_to(masked_mean(vectors, mask), vectors.shape)
        # Lengths, and products with the mean of all points, in place of products with learned axes a point.
        x = jnp.concatenate([norm(vectors), channel_products(vectors, whole), norm(whole)], axis=-1)
        x = nn.leaky_relu(nn.LayerNorm()(nn.Dense(2 * CODE)(x)), 0.2)
        most = jnp.where(mask[:, None], x, -FAR).max(axis=0)
        x = nn.leaky_relu(nn.Dense(CODE)(jnp.concatenate([most, masked_mean(x, mask)])), 0.2)
        x = nn.Dense(CODE)(x)
        return x / jnp.sqrt(jnp.sum(x * x) + 1e-12)

    def unit_code(self, points: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Float[Array, " code"]:
        """What a cloud is matched by."""
        return self(points, mask)


def matching_loss(network: nn.Module, params: Any, sample: TrainingSample, key: Array) -> Float[Array, ""]:
    """InfoNCE between the two clouds of each shape."""
    codes = jax.vmap(jax.vmap(partial(network.apply, params)))(sample.points, sample.mask)
    codes = jnp.asarray(codes)
    return contrast_loss(codes[:, 0], codes[:, 1], TEMPERATURE)
