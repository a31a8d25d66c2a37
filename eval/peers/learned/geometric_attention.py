"""Attention that knows how superpoints lie: distances, and angles with their neighbors (GeoTransformer, §3.2)."""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from eval.peers.learned.pair_features import angle
from more2_jax.network.vector_neurons import nearest_points

WIDTH, HEADS = 64, 4  # published: 256, 4
NEAREST = 3  # superpoints that angles are taken with, as published
# What a wave's phase is counted in: cloud radii; radians, as published.
DISTANCE, ANGLE = 0.2, 15 * jnp.pi / 180
FAR = 1e9  # taken off scores of what is not there


def waves(x: Float[Array, "*b"], features: int = WIDTH) -> Float[Array, "*b features"]:
    """Sines and cosines of x at frequencies from 1 down to nearly 1e-4, as positions in a sentence are told."""
    phase = x[..., None] * 1e4 ** (-jnp.arange(features // 2) / (features // 2))
    return jnp.concatenate([jnp.sin(phase), jnp.cos(phase)], axis=-1)


class Geometry(nn.Module):
    """A feature a pair of superpoints: of its distance, and of angles at the first with its nearest ones."""

    @nn.compact
    def __call__(self, points: Float[Array, "s 3"], mask: Bool[Array, " s"]) -> Float[Array, "s s w"]:
        offset = points[None] - points[:, None]
        distance = jnp.sqrt(jnp.sum(offset**2, axis=-1) + 1e-12)
        near, real = nearest_points(points, mask, NEAREST + 1)
        # Itself comes first, and stands in for what is missing.
        near = jnp.where(real, near, jnp.arange(len(points))[:, None])[:, 1:]
        towards = points[near] - points[:, None]
        angles = angle(towards[:, None], offset[:, :, None])
        told = nn.Dense(WIDTH)(waves(angles / ANGLE)).max(axis=2)
        return nn.Dense(WIDTH)(waves(distance / DISTANCE)) + told


class Attention(nn.Module):
    """What superpoints ask of others, of their own cloud (then with its geometry) or of the other one."""

    @nn.compact
    def __call__(
        self,
        x: Float[Array, "s w"],
        y: Float[Array, "t w"],
        y_mask: Bool[Array, " t"],
        geometry: Float[Array, "s t w"] | None = None,
    ) -> Float[Array, "s w"]:
        def heads(z: Array, name: str) -> Array:
            return nn.DenseGeneral((HEADS, WIDTH // HEADS), use_bias=False, name=name)(z)

        asked, keys, values = heads(x, "query"), heads(y, "key"), heads(y, "value")
        scores = jnp.einsum("shc,thc->hst", asked, keys)
        if geometry is not None:
            scores += jnp.einsum("shc,sthc->hst", asked, heads(geometry, "geometry"))
        weights = nn.softmax(jnp.where(y_mask, scores / (WIDTH // HEADS) ** 0.5, -FAR), axis=-1)
        told = jnp.einsum("hst,thc->shc", weights, values).reshape(len(x), WIDTH)
        x = nn.LayerNorm()(x + nn.Dense(WIDTH)(told))
        return nn.LayerNorm()(x + nn.Dense(WIDTH)(nn.relu(nn.Dense(2 * WIDTH)(x))))
