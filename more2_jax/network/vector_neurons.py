"""Vector-neuron layers (paper §3.1): features are (..., 3, channels); every layer commutes with rotations.

No layer has a bias (a constant vector would not turn) and none normalizes by a statistic of the batch. All are
differentiable in both modes. Where JAX's own transpose of a layer is slow on CPUs, its tangent is written by hand so
that the transpose of that is quick; there is no rule for the reverse mode alone.
"""

from __future__ import annotations

from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

LEAST_SPARE = 4  # so many candidates more than neighbors, or half as many, before exact distances decide
TINY = 1e-30  # guards squared norms: far below any feature, so it changes none (1e-12 would)
FAR = 1e30  # squared distance to a row that is not there: larger than any, yet finite
NO_DIRECTION = 1e-19  # squared; its inverse square, in the gradient of a division, is still a float32

EdgeParts = tuple[Float[Array, "_ 3 o"], Float[Array, "_ 3 o"]]  # linear part, and its direction

# Unit gain keeps features near unit size through the blocks; smaller gains let them vanish.
kernel_init = nn.initializers.variance_scaling(1.0, "fan_in", "normal")


def norm(x: Float[Array, "*b 3 c"]) -> Float[Array, "*b c"]:
    """Length of every vector; its gradient at 0 is 0, not NaN."""
    return jnp.sqrt(jnp.maximum(jnp.sum(x * x, axis=-2), TINY))


def channel_normalize(x: Float[Array, "*b 3 c"]) -> Float[Array, "*b 3 c"]:
    """Scales so that the squared lengths of all channels sum to 1 (unit direction times share of the norm)."""
    squared = jnp.sum(x * x, axis=(-2, -1), keepdims=True)
    # The choice comes before the root: behind it, an infinite slope times 0 would make the gradient NaN.
    return x * jax.lax.rsqrt(jnp.where(squared > TINY, squared, 1.0))


def dot(a: Float[Array, "*b 3 c"], b: Float[Array, "*b 3 d"]) -> Float[Array, "*b 1 c"]:
    """Inner product of every pair of vectors; `d` is c, or 1."""
    # Written out: as a reduction it becomes a loop of its own on CPUs, three times slower.
    x, y, z = a[..., 0, :] * b[..., 0, :], a[..., 1, :] * b[..., 1, :], a[..., 2, :] * b[..., 2, :]
    return (x + y + z)[..., None, :]


@jax.custom_jvp
def channel_products(a: Float[Array, "*b 3 c"], b: Float[Array, "*b 3 c"]) -> Float[Array, "*b c"]:
    """Inner products ⟨a, b⟩ channel by channel: `dot`, five times as fast to differentiate on CPUs."""
    return dot(a, b)[..., 0, :]


@channel_products.defjvp
def _channel_products_tangent(at: tuple[Array, Array], tangent: tuple[Array, Array]) -> tuple[Array, Array]:
    (a, b), (d_a, d_b) = at, tangent
    # A reduction, unlike `dot`: the transpose of a reduction is a broadcast, that of slices writes and adds up copies.
    return channel_products(a, b), jnp.sum(d_a * b + a * d_b, axis=-2)


def vn_leaky_relu(
    q: Float[Array, "*b 3 c"],
    k: Float[Array, "*b 3 d"],
    leak: float,
    weight: Float[Array, "*b 1 w"] | None = None,
) -> Float[Array, "*b 3 c"]:
    """Where ⟨q, k⟩ < 0, takes (1 − leak) of the part of q along k away; then times `weight`.

    `d` is c, or 1 to share a direction; `w` is c, or 1.
    """
    # Recomputed when differentiated in reverse: q and k are kept in memory, what is found of them is not.
    activated = jax.checkpoint(_leaky_relu, prevent_cse=False, static_argnums=3)
    return activated(q, k, weight, leak)


@partial(jax.custom_jvp, nondiff_argnums=(3,))
def _leaky_relu(q: Array, k: Array, weight: Array | None, leak: float) -> Array:
    length, along = dot(k, k), dot(q, k)
    # A zero direction removes nothing; dividing by 1 there keeps the gradient finite.
    share = jnp.minimum(along, 0.0) / jnp.where(length > NO_DIRECTION, length, 1.0)
    return _weighted(weight, q - (1.0 - leak) * share * k)


@_leaky_relu.defjvp
def _leaky_relu_tangent(
    leak: float, at: tuple[Array, Array, Array | None], tangent: tuple[Array, Array, Array | None]
) -> tuple[Array, Array]:
    """The tangent, in a form whose transpose is quick on CPUs: five times as fast as JAX's own of `dot`'s slices.

    Inner products are reductions and multiples of vectors are concatenations, so that transposed they become
    broadcasts and sums of slices. Every factor ends (transposed, begins) in its division: XLA never computes a
    quotient twice, so each is stored, at a third of the size of q, instead of being found anew for every component.
    """
    (q, k, weight), (d_q, d_k, d_weight) = at, tangent
    along, length = dot(q, k), dot(k, k)
    has_direction = length > NO_DIRECTION
    safe = jnp.where(has_direction, length, 1.0)
    removed = jnp.where((along < 0) & has_direction, _weighted(weight, jnp.full_like(along, 1.0 - leak)), 0.0)
    d_along = jnp.sum(k * d_q + q * d_k, axis=-2, keepdims=True)
    d_length = 2.0 * jnp.sum(k * d_k, axis=-2, keepdims=True)
    d_share = (d_along - d_length / safe * along) / safe * removed
    d_result = _weighted(weight, d_q) - removed * along / safe * d_k - _multiple(d_share, k)
    if d_weight is not None:
        d_result = d_result + _multiple(d_weight, _leaky_relu(q, k, None, leak))
    return _leaky_relu(q, k, weight, leak), d_result


def _weighted(weight: Array | None, x: Array) -> Array:
    return x if weight is None else weight * x


def _multiple(factor: Float[Array, "*b 1 _"], x: Float[Array, "*b 3 _"]) -> Float[Array, "*b 3 _"]:
    """factor · x; its transpose by `factor` adds three slices up, where that of a plain product would reduce."""
    return jnp.concatenate([factor * x[..., i : i + 1, :] for i in range(3)], axis=-2)


def linear(x: Float[Array, "*b i"], kernel: Float[Array, "i o"]) -> Float[Array, "*b o"]:
    """x @ kernel, for training on CPUs: of many rows, the kernel's gradient is a product a cloud, then their sum.

    Differentiation of a batch contracts over clouds and rows at once, which XLA turns into a product of transposed
    copies there. Of few rows the sum costs more than it saves.
    """
    rows = x.reshape(-1, x.shape[-1])
    if len(rows) < max(kernel.shape):
        return x @ kernel
    product = jax.lax.platform_dependent(rows, kernel, cpu=_product_by_cloud, default=jnp.matmul)
    return product.reshape(*x.shape[:-1], kernel.shape[-1])


@jax.custom_jvp
def _product_by_cloud(rows: Array, kernel: Array) -> Array:
    return _exact_product(rows, kernel)


@_product_by_cloud.defjvp
def _product_by_cloud_tangent(at: tuple[Array, Array], tangent: tuple[Array, Array]) -> tuple[Array, Array]:
    (rows, kernel), (d_rows, d_kernel) = at, tangent
    # A 1 that depends on the cloud gives every cloud of a batch a tangent of the kernel of its own. Transposed, that is
    # a gradient a cloud and their sum.
    one = jnp.where(rows[0, 0] > 0, 1.0, 1.0).astype(rows.dtype)
    of_both = _exact_product(d_rows, kernel) + _exact_product(rows, one * d_kernel)
    return _exact_product(rows, kernel), of_both


def _exact_product(rows: Array, kernel: Array) -> Array:
    # Said outright, though it costs a CPU nothing: a rule of differentiation is traced where no door says it.
    return jnp.matmul(rows, kernel, precision="highest")


class VNLAWeights(nn.Module):
    """Kernel and directions of a VNLA, for callers that apply it an edge at a time."""

    inputs: int
    features: int

    @nn.compact
    def __call__(self) -> tuple[Float[Array, "i o"], Float[Array, "o o"]]:
        kernel = self.param("kernel", kernel_init, (self.inputs, self.features))
        return kernel, self.param("direction", kernel_init, (self.features, self.features))


class VNLA(nn.Module):
    """VN-Linear, then VN-LeakyReLU along a learned direction."""

    features: int
    leak: float
    shared_direction: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "*b 3 i"]) -> Float[Array, "*b 3 o"]:
        kernel = self.param("kernel", kernel_init, (x.shape[-1], self.features))
        directions = 1 if self.shared_direction else self.features
        direction = self.param("direction", kernel_init, (self.features, directions))
        q = linear(x, kernel)
        return vn_leaky_relu(q, linear(q, direction), self.leak)


class EdgeVNLA(nn.Module):
    """VNLA on the graph feature [f_j − f_i, f_i], by the exact algebra of per-point products.

    Both the linear map and its direction are linear in f_j and in f_i, so each is a product per *point*, added
    per edge: the same numbers as the plain form, with `neighbors` times fewer
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
        of_neighbor = linear(source, kernel[:width])
        of_self = linear(query, kernel[width:] - kernel[:width])
        # The direction after the product, not folded into one kernel: half the rounding at the same cost.
        return (of_neighbor, linear(of_neighbor, direction)), (of_self, linear(of_self, direction))


def edge_vnla(
    of_neighbor: EdgeParts, of_self: EdgeParts, leak: float, weight: Float[Array, "n 1 w"] | None = None
) -> Float[Array, "n 3 o"]:
    """VNLA of one edge a query, from its two parts, times `weight`."""
    return vn_leaky_relu(of_neighbor[0] + of_self[0], of_neighbor[1] + of_self[1], leak, weight)


def nearest_points(
    points: Float[Array, "n 3"], mask: Bool[Array, "n"], k: int
) -> tuple[Int[Array, "n k"], Bool[Array, "n k"]]:
    """Indices of the `k` nearest points, itself included, and which of them are real."""
    x, y, z = jax.lax.stop_gradient(points).T
    # Of three numbers, the sum of squared differences costs a fifth of a product of matrices and needs no second look.
    squared = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2 + (z[:, None] - z) ** 2
    nearest, index = jax.lax.top_k(jnp.where(mask, -squared, -jnp.inf), k)
    return index, jnp.isfinite(nearest)


def nearest_features(
    query: Float[Array, "n 3 c"],
    source: Float[Array, "m 3 c"],
    source_mask: Bool[Array, "m"],
    k: int,
) -> tuple[Int[Array, "n k"], Bool[Array, "n k"]]:
    """Indices of the `k` nearest sources in feature space, itself included, and which of them are real."""
    a, b = jax.lax.stop_gradient((query.reshape(len(query), -1), source.reshape(len(source), -1)))
    # 2⟨a, b⟩ − |b|² as one product: |a|² is the same for a whole row, and a matrix of n m numbers is written once.
    squared = jnp.where(source_mask, jnp.sum(b * b, axis=-1), FAR)
    ones = jnp.ones((len(a), 1), a.dtype)
    rows, columns = jnp.concatenate([2 * a, -ones], axis=-1), jnp.concatenate([b, squared[:, None]], axis=-1)
    closeness = jnp.matmul(rows, columns.T, precision="highest")
    _, candidate = jax.lax.top_k(closeness, min(k + max(k // 2, LEAST_SPARE), len(b)))
    # The expansion cancels, and a swapped k-th neighbor moves the code by percents: the last word has the
    # sum of squared differences.
    exact = jnp.sum((a[:, None] - b[candidate]) ** 2, axis=-1)
    nearest, rank = jax.lax.top_k(jnp.where(source_mask[candidate], -exact, -jnp.inf), k)
    return jnp.take_along_axis(candidate, rank, axis=1), jnp.isfinite(nearest)


def masked_mean(x: Float[Array, "n *f"], mask: Bool[Array, "n"], axis: int = 0) -> Float[Array, "*f"]:
    """Mean over the rows where `mask` holds."""
    weight = mask.astype(x.dtype) / jnp.maximum(mask.sum(), 1)
    return jnp.tensordot(weight, x, axes=(0, axis), precision="highest")
