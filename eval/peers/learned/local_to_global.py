"""From soft partners in many pairs of patches to one pose: each pair's own, the best of these, then all together."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from eval.peers.learned.weighted_pose import pose

MUTUAL = 3  # a partner is among so many best of both points, as published
INLIER = 0.15  # cloud radii: a partner that lands nearer agrees with a pose
ROUNDS = 5  # as published


def mutual(partners: Float[Array, "k p q"]) -> Float[Array, "k p q"]:
    """Weights of those that are among the best of both points, 0 elsewhere."""
    rows, columns = (jnp.sort(partners, axis=axis) for axis in (2, 1))
    best = (partners >= rows[:, :, -MUTUAL, None]) & (partners >= columns[:, None, -MUTUAL, :])
    return jnp.where(best & (partners > 0.05), partners, 0.0)


def local_to_global(
    source: Float[Array, "k p 3"], target: Float[Array, "k q 3"], weight: Float[Array, "k p q"], upright: bool
) -> Float[Array, "4 4"]:
    """`T_target_source`: the pose of a pair of patches that most partners of all agree with, refined by those."""
    shape = (*weight.shape, 3)
    a = jnp.broadcast_to(source[:, :, None], shape).reshape(len(weight), -1, 3)
    b = jnp.broadcast_to(target[:, None], shape).reshape(len(weight), -1, 3)
    w = weight.reshape(len(weight), -1)
    every = a.reshape(-1, 3), b.reshape(-1, 3)

    def agreeing(T: Float[Array, "4 4"]) -> Float[Array, " e"]:
        landed = every[0] @ T[:3, :3].T + T[:3, 3]
        return jnp.where(jnp.sum((landed - every[1]) ** 2, axis=-1) < INLIER**2, w.reshape(-1), 0.0)

    own = jax.vmap(partial(pose, upright=upright))(a, b, w)
    T = own[jnp.argmax(jax.vmap(lambda T: agreeing(T).sum())(own))]
    for _ in range(ROUNDS):
        T = pose(*every, agreeing(T), upright)
    return T
