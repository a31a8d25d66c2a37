"""The published layers written down plainly in JAX: every edge's feature is built, stored and multiplied.

The yardstick of eval/speed.py, with our weights: the same outputs to rounding, none of the algebra (paper §3.1).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from more2_jax.config import EncoderConfig, PriorConfig

Outputs = tuple[Array, Array, Array, Array]  # F_inv, F_eqv, F_s, F_c
TINY = 1e-30


def normalized(x: Float[Array, "*b 3 c"]) -> Float[Array, "*b 3 c"]:
    """Squared lengths of all channels sum to 1."""
    return x / jnp.sqrt(jnp.sum(x * x, axis=(-2, -1), keepdims=True) + TINY)


def relu(q: Float[Array, "*b 3 c"], k: Float[Array, "*b 3 d"], leak: float) -> Float[Array, "*b 3 c"]:
    """VN-LeakyReLU of q along k."""
    k = k / jnp.sqrt(jnp.sum(k * k, axis=-2, keepdims=True) + TINY)
    along = jnp.sum(q * k, axis=-2, keepdims=True)
    return q - (1 - leak) * jnp.minimum(along, 0.0) * k


def vnla(w: Mapping[str, Array], x: Float[Array, "*b 3 i"], leak: float) -> Float[Array, "*b 3 o"]:
    """VN-Linear, then VN-LeakyReLU."""
    q = x @ w["kernel"]
    return relu(q, q @ w["direction"], leak)


def edges(
    query: Float[Array, "n 3 i"], source: Float[Array, "m 3 i"], k: int, first: bool
) -> Float[Array, "n k 3 j"]:
    """The graph feature [f_j − f_i, f_i] of every edge; in the first block the cross product before it."""
    a, b = query.reshape(len(query), -1), source.reshape(len(source), -1)
    squared = jnp.sum(a * a, axis=1)[:, None] + jnp.sum(b * b, axis=1) - 2 * a @ b.T
    other = source[jax.lax.top_k(-jax.lax.stop_gradient(squared), k)[1]]
    own = jnp.broadcast_to(query[:, None], other.shape)
    if not first:
        return jnp.concatenate([other - own, own], axis=-1)
    unit = own / jnp.sqrt(jnp.sum(own * own, axis=-2, keepdims=True) + TINY)
    return jnp.concatenate([jnp.cross(unit, other, axis=-2), other - own, own], axis=-1)


def attention(
    w: Mapping[str, Any], query: Float[Array, "n 3 i"], graph: Float[Array, "n k 3 j"], c: EncoderConfig
) -> Float[Array, "n 3 o"]:
    """Attention over all edges, then the global context."""
    q = normalized(vnla(w["query"], query, c.leak))
    k = normalized(vnla(w["key"], graph, c.leak))
    v = vnla(w["value"], graph, c.leak)
    n, neighbors, _, width = v.shape
    by_head = (q[:, None] * k).reshape(n, neighbors, 3, -1, c.head_channels).sum(axis=(2, 4))
    share = jax.nn.softmax(by_head / jnp.sqrt(3.0 * c.head_channels), axis=1)
    mixed = jnp.sum(jnp.repeat(share, c.head_channels, axis=-1)[:, :, None] * v, axis=1)
    context = jnp.broadcast_to(mixed.mean(axis=0), (n, 3, width))
    return vnla(w["context"], jnp.concatenate([mixed, context], axis=-1), c.leak)


def encode(w: Mapping[str, Any], points: Float[Array, "n 3"], c: EncoderConfig) -> Outputs:
    """Φ of one cloud whose rows are in farthest-point order."""
    mean = points.mean(axis=0)
    features = (points - mean)[..., None]
    thinning = dict(zip(c.downsample_blocks, c.downsample_factors, strict=True))
    for i in range(len(c.widths)):
        query = features[: len(features) // thinning.get(i, 1)]
        graph, block = edges(query, features, c.neighbors, first=i == 0), w[f"block_{i}"]
        if i < c.linear_blocks:
            features = vnla(block["value"], graph, c.leak).mean(axis=1)
        else:
            features = attention(block, query, graph, c)
    x = vnla(w["head"], features, c.leak).mean(axis=0)
    eqv, center = normalized(x), w["center"]
    q = vnla(center["inner"], x, c.leak) @ center["residual"] + x @ center["shortcut"]
    offset = relu(q, q @ center["direction"], c.leak)[..., 0]
    inv = jnp.sum(normalized(x @ w["invariant"]) * eqv, axis=-2)
    scale = jnp.sqrt(jnp.sum(x * x, axis=-2) + TINY).mean() * c.output_scale
    return inv, eqv, scale, mean + offset * c.output_scale


def decode(
    w: Mapping[str, Any], code: Outputs, points: Float[Array, "q 3"], config: PriorConfig
) -> Float[Array, " q"]:
    """Ψ of one object, nothing folded: [F_inv, ⟨F_eqv, q⟩, |q|] of every query through every layer."""
    inv, eqv, scale, center = code
    q = (points - center) / scale
    length = jnp.sqrt(jnp.sum(q * q, axis=-1, keepdims=True) + TINY)
    of_code = jnp.broadcast_to(config.inv_gain * inv, (len(q), len(inv)))
    inputs = h = jnp.concatenate([of_code, config.eqv_gain * (q @ eqv), length], axis=-1)
    for i in range(config.decoder.layers):
        h = jnp.concatenate([h, inputs], axis=-1) if i == config.decoder.skip_layer else h
        layer = w[f"layer_{i}"]
        kernel = layer["direction"] * (layer["gain"] / jnp.linalg.norm(layer["direction"], axis=0))
        h = jax.nn.relu(h @ kernel + layer["bias"])
    last = w[f"layer_{config.decoder.layers}"]
    return jnp.tanh(h @ last["kernel"] + last["bias"])[..., 0]
