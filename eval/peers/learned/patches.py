"""Superpoints and the points around each: what two clouds are matched by, first coarsely, then point by point."""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

SUPERPOINTS = 24  # the first farthest points of a cloud; published: the coarsest voxels
MEMBERS = 16  # most points of a patch; published: 64
FAR = 1e9


@flax.struct.dataclass
class Patches:
    """Every point belongs to its nearest superpoint; of a patch with many, the nearest ones."""

    centers: Float[Array, "s 3"]
    mask: Bool[Array, " s"]  # superpoints that are real
    owner: Int[Array, " n"]  # superpoint of every point; `SUPERPOINTS` of rows that are not real
    members: Int[Array, "s p"]  # rows of points
    real: Bool[Array, "s p"]


def patches_of(points: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Patches:
    """Patches of a cloud in farthest-point order, whose first points are spread as evenly as all."""
    centers, real = points[:SUPERPOINTS], mask[:SUPERPOINTS]
    squared = jnp.sum((points[:, None] - centers) ** 2, axis=-1)
    owner = jnp.where(mask, jnp.argmin(jnp.where(real, squared, FAR), axis=1), SUPERPOINTS)
    own = owner[:, None] == jnp.arange(SUPERPOINTS)
    near, members = jax.lax.top_k(jnp.where(own, -squared, -FAR).T, MEMBERS)
    return Patches(centers=centers, mask=real, owner=owner, members=members, real=near > -FAR)


def overlap(partner: Bool[Array, "n m"], a: Patches, b: Patches) -> Float[Array, "s t"]:
    """Share of the points of every patch of a that have a partner in every patch of b."""
    of_a = jax.nn.one_hot(a.owner, SUPERPOINTS)
    in_patch = (partner.astype(jnp.float32) @ jax.nn.one_hot(b.owner, SUPERPOINTS)) > 0
    held = of_a.T @ in_patch
    return jnp.where(a.mask[:, None] & b.mask, held / jnp.maximum(of_a.sum(axis=0), 1)[:, None], 0.0)
