"""The pose that weighted pairs of points vote for, of any turn or of turns about the vertical."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from eval.peers.learned.clouds import about_vertical
from more2_jax.geometry.points import kabsch
from more2_jax.registration.starting_poses import yaw_of

LEAST = 1e-9


def pose(
    source: Float[Array, "n 3"], target: Float[Array, "n 3"], weight: Float[Array, " n"], upright: bool
) -> Float[Array, "4 4"]:
    """The best pose between rows that belong together; with `upright`, the best of turns about z."""
    if not upright:
        return kabsch(source, target, weight).as_matrix()
    share = weight / jnp.maximum(weight.sum(), LEAST)
    mean, meant = share @ source, share @ target
    h = ((source - mean) * share[:, None]).T @ (target - meant)
    R = about_vertical(yaw_of(h.T))
    top = jnp.concatenate([R, (meant - R @ mean)[:, None]], axis=1)
    return jnp.concatenate([top, jnp.array([[0.0, 0.0, 0.0, 1.0]])])
