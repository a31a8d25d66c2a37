"""A code as the mean over draws of the same cloud: the encoder reads few points, and which ones changes what it says.

The mean of equivariant codes is equivariant. The first draw is the whole cloud. The others are random halves of it, or
more where it is small, chosen by the order of distances from the mean: whatever moves the cloud, or shuffles its rows,
leaves them as they are.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from more2_jax.network.vector_neurons import channel_normalize
from more2_jax.types import Anchors, Embedding

SPARE = 1.5  # points of a draw, of those that the encoder reads: sampling is to have a choice


def draws(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"], count: int, read: int
) -> Bool[Array, "count n"]:
    """The rows of each draw, for an encoder that reads so many points. Masked points must be finite."""
    rank = _from_the_middle(jax.lax.stop_gradient(points), mask)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(0), rank)
    share = jnp.clip(SPARE * read / mask.sum(), 0.5, 1.0)
    some = jax.vmap(lambda key: jax.random.uniform(key, (count - 1,), jnp.float32) < share, out_axes=1)(keys)
    first = jnp.arange(len(mask)) == jnp.argmax(mask)  # where the sampling begins
    return jnp.concatenate([mask[None], mask & (some | first)])


def _from_the_middle(points: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Int[Array, " n"]:
    """How many points are nearer to the mean than each; masked ones come last."""
    mean = (points * mask[:, None]).sum(axis=0) / jnp.maximum(mask.sum(), 1)
    distance = jnp.where(mask, jnp.sum((points - mean) ** 2, axis=1), jnp.inf)
    return jnp.argsort(jnp.argsort(distance))


def mean_code(codes: Embedding) -> Embedding:
    """The mean of the codes of all draws (leading axis), F_eqv of unit norm again.

    Anchors are the first draw's, relative to the mean center.
    """
    first = jax.tree.map(lambda x: x[0], codes)
    center = codes.center.mean(axis=0)
    shift = first.center - center
    return dataclasses.replace(
        first,
        inv=codes.inv.mean(axis=0),
        eqv=channel_normalize(codes.eqv.mean(axis=0)),
        scale=codes.scale.mean(axis=0),
        center=center,
        anchors=tuple(_moved(a, shift) for a in first.anchors),
    )


def _moved(anchors: Anchors, shift: Float[Array, " 3"]) -> Anchors:
    offset = jnp.where(anchors.mask[:, None], anchors.offset + shift, 0.0)
    return dataclasses.replace(anchors, offset=offset)
