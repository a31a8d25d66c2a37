"""Farthest points, nearest neighbours, Kabsch, chamfer: geometry for one cloud or one pair; vmap outside."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
from jax import Array
from jaxtyping import Bool, Float, Int

TINY = 1e-30


def farthest_points(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"], count: int
) -> tuple[Float[Array, "count 3"], Bool[Array, " count"]]:
    """Farthest-point sampling from row 0; any prefix of the result is itself a farthest-point sample.

    Exact duplicates are taken once: rows beyond the distinct points repeat one and are masked out.
    """

    def step(
        nearest: Float[Array, " n"], chosen: Int[Array, ""]
    ) -> tuple[Float[Array, " n"], Float[Array, ""]]:
        offset = points - points[chosen]
        nearest = jnp.minimum(nearest, jnp.sum(offset * offset, axis=-1))
        return nearest, jnp.max(nearest)

    def body(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        nearest, chosen = carry
        nearest, farthest = step(nearest, chosen)
        return (nearest, jnp.argmax(nearest)), (chosen, farthest > 0)

    start = (jnp.where(mask, jnp.inf, -1.0), jnp.argmax(mask))
    _, (index, more) = jax.lax.scan(body, start, length=count)
    real = jnp.concatenate([jnp.ones(1, bool), more[:-1]]) & mask[0:1]
    return points[index], real


def kabsch_rotation(source: Float[Array, "n 3"], target: Float[Array, "n 3"]) -> Float[Array, "3 3"]:
    """The rotation that best turns row i of `source` onto row i of `target`, both already centred.

    Horn's quaternion: the eigenvector of a symmetric 4×4 matrix, never a reflection, also when the points lie
    on a plane, a line or a point. Found by repeated squaring, so that its gradient is finite where that of an
    SVD is not (equal singular values).
    """
    covariance = jnp.matmul(source.T, target, precision="highest")
    return quaternion_matrix(dominant_eigenvector(horn_matrix(covariance)))


def horn_matrix(h: Float[Array, "3 3"]) -> Float[Array, "4 4"]:
    """Horn's symmetric matrix of a covariance Σ sᵢ tᵢᵀ; its top eigenvector is the quaternion (w, x, y, z)."""
    trace = jnp.trace(h)
    vector = jnp.stack([h[1, 2] - h[2, 1], h[2, 0] - h[0, 2], h[0, 1] - h[1, 0]])
    block = h + h.T - trace * jnp.eye(3)
    return jnp.block([[trace[None, None], vector[None]], [vector[:, None], block]])


def quaternion_matrix(q: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Rotation matrix of a unit quaternion (w, x, y, z)."""
    return jaxlie.SO3(q).as_matrix()


def dominant_eigenvector(matrix: Float[Array, "4 4"]) -> Float[Array, "4"]:
    """Unit eigenvector of the largest eigenvalue of a symmetric matrix, with finite gradients everywhere.

    A zero matrix (no evidence at all) gives (1, 0, 0, 0), the identity rotation.
    """
    size = jnp.sqrt(jnp.sum(matrix * matrix) + TINY)
    power = matrix / size + jnp.eye(4)  # eigenvalues in [0, 2]: the largest becomes the dominant one
    for _ in range(24):
        power = power @ power
        power = power / jnp.trace(power)
    # Any column is the eigenvector times a component of it; the longest is the safest.
    column = power[:, jnp.argmax(jnp.diagonal(power))]
    return column / jnp.sqrt(jnp.sum(column * column) + TINY)
