"""Vector-neuron layers (METHOD 1): features are (..., 3, channels); every layer commutes with rotations.

No layer has a bias (a constant vector would not turn) and none normalises by a statistic of the batch.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

SPARE = 8  # more candidates than neighbours asked for, before exact distances decide
TINY = 1e-30  # guards squared norms: far below any feature, so it changes none (1e-12 would)
NO_DIRECTION = 1e-19  # squared; its inverse square, in the gradient of a division, is still a float32

# Unit gain keeps features near unit size through the blocks; smaller gains let them vanish.
kernel_init = nn.initializers.variance_scaling(1.0, "fan_in", "normal")


def norm(x: Float[Array, "*b 3 c"]) -> Float[Array, "*b c"]:
    """Length of every vector; its gradient at 0 is 0, not NaN."""
    return jnp.sqrt(jnp.maximum(jnp.sum(x * x, axis=-2), TINY))


def channel_normalise(x: Float[Array, "*b 3 c"]) -> Float[Array, "*b 3 c"]:
    """Scales so that the squared lengths of all channels sum to 1 (unit direction times share of the norm)."""
    squared = jnp.sum(x * x, axis=(-2, -1), keepdims=True)
    # The choice comes before the root: behind it, an infinite slope times 0 would make the gradient NaN.
    return x * jax.lax.rsqrt(jnp.where(squared > TINY, squared, 1.0))


def vn_leaky_relu(
    q: Float[Array, "*b 3 c"], k: Float[Array, "*b 3 d"], leak: float
) -> Float[Array, "*b 3 c"]:
    """Where ⟨q, k⟩ < 0, takes (1 − leak) of the part of q along k away. `d` is c, or 1 to share a direction."""
    along = jnp.sum(q * k, axis=-2, keepdims=True)
    length = jnp.sum(k * k, axis=-2, keepdims=True)
    # A zero direction removes nothing; dividing by 1 there keeps the gradient finite.
    share = jnp.minimum(along, 0.0) / jnp.where(length > NO_DIRECTION, length, 1.0)
    return q - (1.0 - leak) * share * k


class VNLA(nn.Module):
    """VN-Linear, then VN-LeakyReLU along a learnt direction."""

    features: int
    leak: float
    shared_direction: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "*b 3 i"]) -> Float[Array, "*b 3 o"]:
        kernel = self.param("kernel", kernel_init, (x.shape[-1], self.features))
        directions = 1 if self.shared_direction else self.features
        direction = self.param("direction", kernel_init, (self.features, directions))
        q = x @ kernel
        return vn_leaky_relu(q, q @ direction, self.leak)


class EdgeVNLA(nn.Module):
    """VNLA on the graph feature [f_j − f_i, f_i], by the exact algebra of per-point products.

    Both the linear map and its direction are linear in f_j and in f_i, so each is a product per *point*,
    gathered and added per edge: the same numbers as the plain form in tests/oracles.py, with `neighbours`
    times fewer multiplications.
    """

    features: int
    leak: float

    @nn.compact
    def __call__(
        self, source: Float[Array, "m 3 i"], query: Float[Array, "n 3 i"], neighbours: Int[Array, "n k"]
    ) -> Float[Array, "n k 3 o"]:
        width = source.shape[-1]
        kernel = self.param("kernel", kernel_init, (2 * width, self.features))
        direction = self.param("direction", kernel_init, (self.features, self.features))
        of_neighbour = source @ kernel[:width]
        of_self = query @ (kernel[width:] - kernel[:width])
        # The direction after the product, not folded into one kernel: half the rounding at the same cost.
        of_neighbour = jnp.concatenate([of_neighbour, of_neighbour @ direction], axis=-1)
        of_self = jnp.concatenate([of_self, of_self @ direction], axis=-1)
        edge = of_neighbour[neighbours] + of_self[:, None]
        return vn_leaky_relu(edge[..., : self.features], edge[..., self.features :], self.leak)


def nearest_features(
    query: Float[Array, "n 3 c"],
    source: Float[Array, "m 3 c"],
    source_mask: Bool[Array, "m"],
    k: int,
) -> tuple[Int[Array, "n k"], Bool[Array, "n k"]]:
    """Indices of the `k` nearest sources in feature space, itself included, and which of them are real."""
    a, b = jax.lax.stop_gradient((query.reshape(len(query), -1), source.reshape(len(source), -1)))
    product = jnp.matmul(a, b.T, precision="highest")
    # |a|² is the same for a whole row, so it does not change the order.
    distance = jnp.where(source_mask, jnp.sum(b * b, axis=-1) - 2 * product, jnp.inf)
    rough, candidate = jax.lax.top_k(-distance, min(k + SPARE, len(b)))
    # The expansion cancels, and a swapped k-th neighbour moves the code by percents: the last word has the
    # sum of squared differences.
    exact = jnp.sum((a[:, None] - b[candidate]) ** 2, axis=-1)
    nearest, rank = jax.lax.top_k(jnp.where(jnp.isfinite(rough), -exact, -jnp.inf), k)
    return jnp.take_along_axis(candidate, rank, axis=1), jnp.isfinite(nearest)


def masked_mean(x: Float[Array, "n *f"], mask: Bool[Array, "n"], axis: int = 0) -> Float[Array, "*f"]:
    """Mean over the rows where `mask` holds."""
    weight = mask.astype(x.dtype) / jnp.maximum(mask.sum(), 1)
    return jnp.tensordot(weight, x, axes=(0, axis))
