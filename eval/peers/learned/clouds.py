"""Clouds as the networks take them: as many farthest points each, about their mean, in units of their radius."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import flax.struct
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from more2_jax.geometry.padding import MAX_POINTS, pad_clouds
from more2_jax.geometry.points import farthest_points
from more2_jax.geometry.poses import Points
from more2_jax.network.vector_neurons import TINY, masked_mean


@flax.struct.dataclass
class Centered:
    """A cloud about its mean in units of its radius (root mean square); rows that are not real are 0."""

    points: Float[Array, "*b n 3"]
    mask: Bool[Array, "*b n"]
    mean: Float[Array, "*b 3"]  # of the cloud as it came, in its units
    radius: Float[Array, "*b"]

    def local(self, points: Float[Array, "*b q 3"]) -> Float[Array, "*b q 3"]:
        """Points of the cloud's own frame in that of the network."""
        return (points - self.mean[..., None, :]) / self.radius[..., None, None]


def centered(points: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Centered:
    """One cloud about its mean, in units of its radius; what rows that are not real hold does not matter."""
    points = jnp.where(mask[:, None], points, 0.0)
    mean = masked_mean(points, mask)
    offset = jnp.where(mask[:, None], points - mean, 0.0)
    radius = jnp.sqrt(jnp.maximum(masked_mean(jnp.sum(offset**2, axis=-1), mask), TINY))
    return Centered(points=offset / radius, mask=mask, mean=mean, radius=radius)


@partial(jax.jit, static_argnames="count")
def _farthest(points: Float[Array, "b n 3"], mask: Bool[Array, "b n"], count: int) -> tuple[Array, Array]:
    return jax.vmap(partial(farthest_points, count=count))(points, mask)


def thinned(
    clouds: Sequence[Points], count: int
) -> tuple[Float[Array, "b n 3"], Bool[Array, "b n"], Float[np.ndarray, "b 3"]]:
    """`count` farthest points of each cloud (meters), which of them are real, and the origins they are relative to."""
    cloud = pad_clouds(clouds, MAX_POINTS)
    # A cloud a call: one program for any number of clouds.
    found = [_farthest(p[None], m[None], count) for p, m in zip(cloud.points, cloud.mask, strict=True)]
    points, mask = (jnp.concatenate(parts) for parts in zip(*found, strict=True))
    return points, mask, np.asarray(cloud.origin)


def about_vertical(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """The rotation about z, radians."""
    return jaxlie.SO3.from_z_radians(angle).as_matrix()
