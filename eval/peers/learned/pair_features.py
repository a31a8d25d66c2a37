"""What a point and its neighbors are like, whichever way the cloud turns: lengths and angles (Drost et al., PPF)."""

from __future__ import annotations

import flax.struct
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from more2_jax.network.vector_neurons import nearest_points

NEIGHBORS = 12  # RPM-Net, published: those within a radius, 64 at most
LEAST = 1e-9


@flax.struct.dataclass
class Oriented:
    """A cloud with normals, and the neighbors of every point."""

    points: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]
    mask: Bool[Array, " n"]
    neighbors: Array  # (n, k) rows


def oriented(points: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Oriented:
    """Normals by the least spread among neighbors, away from the middle: no camera is known."""
    index, real = nearest_points(points, mask, NEIGHBORS)
    # Fewer points than neighbors: itself again. Not `index[:, :1]`, of which XLA makes a full sort on CPUs.
    index = jnp.where(real, index, jnp.arange(len(points))[:, None])
    offset = points[index] - points[index].mean(axis=1, keepdims=True)
    normals = jnp.linalg.eigh(jnp.einsum("nki,nkj->nij", offset, offset))[1][:, :, 0]
    outward = jnp.where(jnp.sum(normals * points, axis=-1, keepdims=True) < 0, -normals, normals)
    return Oriented(points=points, normals=outward, mask=mask, neighbors=index)


def angle(a: Float[Array, "*n 3"], b: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
    """Between vectors, radians; 0 where one of them vanishes."""
    across = jnp.sqrt(jnp.sum(jnp.cross(a, b) ** 2, axis=-1) + LEAST**2)
    return jnp.arctan2(across, jnp.sum(a * b, axis=-1) + LEAST)


def pair_features(cloud: Oriented) -> Float[Array, "n k 4"]:
    """Length and three angles of every point with each of its neighbors; turning the cloud changes none."""
    d = cloud.points[cloud.neighbors] - cloud.points[:, None]
    own, other = jnp.broadcast_to(cloud.normals[:, None], d.shape), cloud.normals[cloud.neighbors]
    length = jnp.sqrt(jnp.sum(d * d, axis=-1) + LEAST**2)
    return jnp.stack([length, angle(own, d), angle(other, d), angle(own, other)], axis=-1)
