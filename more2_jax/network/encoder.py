"""Encoder Φ (paper §3.1): a point cloud to an invariant, an equivariant, a scale and a center code."""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from more2_jax.config import EncoderConfig
from more2_jax.network.neighbor_scan import over_neighbors
from more2_jax.network.vector_neurons import (
    TINY,
    VNLA,
    EdgeParts,
    EdgeVNLA,
    VNLAWeights,
    channel_normalize,
    channel_products,
    edge_vnla,
    kernel_init,
    masked_mean,
    nearest_features,
    nearest_points,
    norm,
    vn_leaky_relu,
)
from more2_jax.types import Anchors, Embedding

Features = Float[Array, "n 3 c"]


def mean_of_sum(total: Features, real: Bool[Array, "n k"]) -> Features:
    """The mean over the real neighbors, from the sum over them."""
    return total / jnp.maximum(real.sum(axis=-1), 1)[:, None, None]


def edge_vectors(vectors: tuple[Array, Array, Array], kernel: Float[Array, "3 c"]) -> Features:
    """The vectors (n, 3) side by side, times the kernel: a sum, as three channels make too narrow a product."""
    a, b, c = (vector[..., None] * row for vector, row in zip(vectors, kernel, strict=True))
    return a + b + c


def power_of_two(x: Float[Array, ""]) -> Float[Array, ""]:
    """The power of two next to `x`, no gradient.

    Every layer is homogeneous, so dividing by it and multiplying back is exact, and a 1 cm and a 100 m object
    pass through the same numbers.
    """
    _, exponent = jnp.frexp(jax.lax.stop_gradient(x))
    return jnp.ldexp(jnp.ones((), x.dtype), jnp.clip(exponent, -60, 60))


class FirstBlock(nn.Module):
    """VNLA on [x̂_i × x_j, x_j − x_i, x_i], mean over neighbors: the cross product makes three channels."""

    config: EncoderConfig

    @nn.compact
    def __call__(self, points: Float[Array, "n 3"], mask: Bool[Array, "n"]) -> Features:
        c = self.config
        index, real = nearest_points(points, mask, c.neighbors)
        length = jnp.sqrt(jnp.maximum(jnp.sum(points**2, axis=-1), TINY))
        kernel, direction = VNLAWeights(3, c.widths[0], name="value")()

        def edge(neighbor: Array, own: tuple[Array, Array], maps: tuple[Array, Array], real: Array) -> Any:
            unit, point = own
            graph = jnp.cross(unit, neighbor), neighbor - point, point
            q, k = (edge_vectors(graph, w) for w in maps)
            return vn_leaky_relu(q, k, c.leak, real[:, None, None]), ()

        # The direction is folded into the kernel: no product of matrices an edge.
        maps = (kernel, kernel @ direction)
        own, counted = (points / length[:, None], points), real.T.astype(points.dtype)
        return mean_of_sum(over_neighbors(edge, points, own, maps, counted, index)[0], real)


class LinearBlock(nn.Module):
    """VNLA on the graph feature, mean over neighbors."""

    config: EncoderConfig
    features: int

    @nn.compact
    def __call__(
        self, source: Float[Array, "m 3 i"], mask: Bool[Array, "m"], query: Float[Array, "n 3 i"]
    ) -> Features:
        c = self.config
        index, real = nearest_features(query, source, mask, c.neighbors)
        of_neighbor, of_self = EdgeVNLA(self.features, name="value")(source, query)
        counted = real.T.astype(query.dtype)

        def edge(neighbor: EdgeParts, own: EdgeParts, _: tuple[()], real: Array) -> Any:
            return edge_vnla(neighbor, own, c.leak, real[:, None, None]), ()

        return mean_of_sum(over_neighbors(edge, of_neighbor, of_self, (), counted, index)[0], real)


class AttentionBlock(nn.Module):
    """Attention over the neighbors, then the mean over all points mixed back in (global context)."""

    config: EncoderConfig
    features: int

    @nn.compact
    def __call__(
        self,
        source: Float[Array, "m 3 i"],
        mask: Bool[Array, "m"],
        query: Float[Array, "n 3 i"],
        query_mask: Bool[Array, "n"],
    ) -> Features:
        c = self.config
        index, real = nearest_features(query, source, mask, c.neighbors)
        asking = channel_normalize(VNLA(self.features, c.leak, name="query")(query))
        key, own_key = EdgeVNLA(self.features, name="key")(source, query)
        value, own_value = EdgeVNLA(self.features, name="value")(source, query)
        heads = head_membership(self.features, c.head_channels)

        def score(neighbor: EdgeParts, own: tuple[Array, EdgeParts], _: tuple[()], __: tuple[()]) -> Any:
            asking, parts = own
            key = edge_vnla(neighbor, parts, c.leak)
            product = jnp.matmul(channel_products(asking, key), heads, precision="highest")
            return (), (product, channel_products(key, key).sum(axis=-1, keepdims=True))

        _, (product, squared) = over_neighbors(score, key, (asking, own_key), (), (), index)
        logit = product * jax.lax.rsqrt(3.0 * c.head_channels * jnp.where(squared > TINY, squared, 1.0))
        weight = jax.nn.softmax(logit, axis=0, where=real.T[..., None])

        def weighted(neighbor: EdgeParts, own: EdgeParts, _: tuple[()], weight: Array) -> Any:
            by_channel = jnp.matmul(weight, heads.T, precision="highest")
            return edge_vnla(neighbor, own, c.leak, by_channel[:, None]), ()

        mixed, _ = over_neighbors(weighted, value, own_value, (), weight, index)
        context = jnp.broadcast_to(masked_mean(mixed, query_mask), mixed.shape)
        return VNLA(self.features, c.leak, name="context")(jnp.concatenate([mixed, context], axis=-1))


def head_membership(features: int, channels: int) -> Float[np.ndarray, "features heads"]:
    """1 where a channel is of a head: a product with it sums by heads, one with its transpose repeats."""
    return np.repeat(np.eye(features // channels, dtype=np.float32), channels, axis=0)


class Center(nn.Module):
    """VN residual block to one vector: the center's offset from the mean of the input."""

    hidden: int
    leak: float

    @nn.compact
    def __call__(self, x: Float[Array, "3 c"]) -> Float[Array, "3"]:
        inner = VNLA(self.hidden, self.leak, name="inner")(x)
        residual = inner @ self.param("residual", kernel_init, (self.hidden, 1))
        q = residual + x @ self.param("shortcut", kernel_init, (x.shape[-1], 1))
        return vn_leaky_relu(q, q @ self.param("direction", kernel_init, (1, 1)), self.leak)[..., 0]


class Encoder(nn.Module):
    """Φ for one cloud whose rows are in farthest-point order, so a prefix *is* the thinned cloud."""

    config: EncoderConfig
    keep: tuple[int, ...] = ()  # blocks whose points and features the embedding takes along

    @nn.compact
    def __call__(
        self, points: Float[Array, "n 3"], mask: Bool[Array, "n"], normals: Float[Array, "n 3"] | None = None
    ) -> Embedding:
        """The codes are of the positions alone; `normals` (zeros: not known) stand by the anchors."""
        c = self.config
        normals = jnp.zeros_like(points) if normals is None else normals
        mean = masked_mean(points, mask)
        centered = jnp.where(mask[:, None], points - mean, 0.0)
        radius = power_of_two(jnp.sqrt(masked_mean(jnp.sum(centered**2, axis=-1), mask)))
        levels = self.blocks(centered / radius, mask)
        features, mask = levels[-1]
        head = VNLA(c.code, c.leak, shared_direction=True, name="head")(features)
        x = masked_mean(head, mask)
        eqv = channel_normalize(x)
        turned = x @ self.param("invariant", kernel_init, (c.code, c.code))
        offset = Center(c.code // 2, c.leak, name="center")(x) * c.output_scale * radius
        return Embedding(
            inv=jnp.sum(channel_normalize(turned) * eqv, axis=-2),
            eqv=eqv,
            scale=norm(x).mean() * c.output_scale * radius,
            center=mean + offset,
            anchors=tuple(anchors(centered - offset, normals, *levels[i]) for i in self.keep),
        )

    def blocks(
        self, points: Float[Array, "n 3"], mask: Bool[Array, "n"]
    ) -> list[tuple[Float[Array, "_ 3 _"], Bool[Array, "_"]]]:
        """What every VN block gives, and which rows of it are real; thinning takes the first rows."""
        c = self.config
        thinning = dict(zip(c.downsample_blocks, c.downsample_factors, strict=True))
        features = FirstBlock(c, name="block_0")(points, mask)
        levels = [(features, mask)]
        for i, width in enumerate(c.widths[1:], start=1):
            keep = len(features) // thinning.get(i, 1)
            query, query_mask = features[:keep], mask[:keep]
            if i < c.linear_blocks:
                features = LinearBlock(c, width, name=f"block_{i}")(features, mask, query)
            else:
                features = AttentionBlock(c, width, name=f"block_{i}")(features, mask, query, query_mask)
            mask = query_mask
            levels.append((features, mask))
        return levels


def anchors(
    offset: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    features: Float[Array, "a 3 f"],
    mask: Bool[Array, " a"],
) -> Anchors:
    """The first rows of the cloud, as many as there are features, each feature brought to unit norm."""
    count = len(features)
    return Anchors(
        offset=offset[:count],
        features=channel_normalize(features),
        mask=mask,
        normal=jnp.where(mask[:, None], normals[:count], 0.0),
    )


def neighbor_counts(config: EncoderConfig, points: int) -> list[int]:
    """How many points every block chooses its neighbors from; each must be at least `neighbors`."""
    thinning = dict(zip(config.downsample_blocks, config.downsample_factors, strict=True))
    counts: list[int] = []
    for i in range(len(config.widths)):
        counts.append(points)
        points //= thinning.get(i, 1)
    return counts
