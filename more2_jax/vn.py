"""Vector-neuron layers (METHOD 1): features are (..., 3, channels); every layer commutes with rotations.

No layer has a bias (a constant vector would not turn) and none normalises by a statistic of the batch.
"""

from __future__ import annotations

from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

SPARE = 8  # more candidates than neighbours asked for, before exact distances decide
TINY = 1e-30  # guards squared norms: far below any feature, so it changes none (1e-12 would)
NO_DIRECTION = 1e-19  # squared; its inverse square, in the gradient of a division, is still a float32

EdgeParts = tuple[Float[Array, "_ 3 o"], Float[Array, "_ 3 o"]]  # linear part, and its direction

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


def dot(a: Float[Array, "*b 3 c"], b: Float[Array, "*b 3 d"]) -> Float[Array, "*b 1 c"]:
    """Inner product of every pair of vectors; `d` is c, or 1."""
    # Written out: as a reduction it becomes a loop of its own on CPUs, three times slower.
    x, y, z = a[..., 0, :] * b[..., 0, :], a[..., 1, :] * b[..., 1, :], a[..., 2, :] * b[..., 2, :]
    return (x + y + z)[..., None, :]


def vn_leaky_relu(
    q: Float[Array, "*b 3 c"], k: Float[Array, "*b 3 d"], leak: float
) -> Float[Array, "*b 3 c"]:
    """Where ⟨q, k⟩ < 0, takes (1 − leak) of the part of q along k away. `d` is c, or 1 to share a direction."""
    result: Array = _leaky(q, k, leak)  # pyright: ignore[reportAssignmentType]
    return result


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def _leaky(q: Array, k: Array, leak: float) -> Array:
    length = dot(k, k)
    # A zero direction removes nothing; dividing by 1 there keeps the gradient finite.
    share = jnp.minimum(dot(q, k), 0.0) / jnp.where(length > NO_DIRECTION, length, 1.0)
    return q - (1.0 - leak) * share * k


def inverse(squared: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """1 / x; 0 where x is too small for the gradient to stay finite."""
    return jnp.where(squared > NO_DIRECTION, 1.0 / jnp.where(squared > NO_DIRECTION, squared, 1.0), 0.0)


def _leaky_forward(q: Array, k: Array, leak: float) -> tuple[Array, tuple[Array, Array]]:
    return vn_leaky_relu(q, k, leak), (q, k)


def _leaky_backward(leak: float, kept: tuple[Array, Array], g: Array) -> tuple[Array, Array]:
    """By hand: what differentiation makes of the three slices in `dot` takes five times as long on CPUs."""
    q, k = kept
    along, unit = dot(q, k), inverse(dot(k, k))
    removed = jnp.where(along < 0, (1.0 - leak) * unit, 0.0)
    of_share = removed * dot(g, k)
    of_k = 2.0 * of_share * along * unit * k - removed * along * g - of_share * q
    if k.shape[-1] != q.shape[-1]:
        of_k = of_k.sum(axis=-1, keepdims=True)
    return g - of_share * k, of_k


_leaky.defvjp(_leaky_forward, _leaky_backward)


class VNLAWeights(nn.Module):
    """Kernel and directions of a VNLA, for callers that apply it an edge at a time."""

    inputs: int
    features: int

    @nn.compact
    def __call__(self) -> tuple[Float[Array, "i o"], Float[Array, "o o"]]:
        kernel = self.param("kernel", kernel_init, (self.inputs, self.features))
        return kernel, self.param("direction", kernel_init, (self.features, self.features))


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

    Both the linear map and its direction are linear in f_j and in f_i, so each is a product per *point*, added
    per edge: the same numbers as the plain form in tests/oracles.py, with `neighbours` times fewer
    multiplications. Returns what `edge_vnla` takes: of every source, and of every query.
    """

    features: int

    @nn.compact
    def __call__(
        self, source: Float[Array, "m 3 i"], query: Float[Array, "n 3 i"]
    ) -> tuple[EdgeParts, EdgeParts]:
        width = source.shape[-1]
        kernel = self.param("kernel", kernel_init, (2 * width, self.features))
        direction = self.param("direction", kernel_init, (self.features, self.features))
        of_neighbour = source @ kernel[:width]
        of_self = query @ (kernel[width:] - kernel[:width])
        # The direction after the product, not folded into one kernel: half the rounding at the same cost.
        return (of_neighbour, of_neighbour @ direction), (of_self, of_self @ direction)


def edge_vnla(of_neighbour: EdgeParts, of_self: EdgeParts, leak: float) -> Float[Array, "n 3 o"]:
    """VNLA of one edge a query, from its two parts."""
    return vn_leaky_relu(of_neighbour[0] + of_self[0], of_neighbour[1] + of_self[1], leak)


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
