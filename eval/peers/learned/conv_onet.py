"""Convolutional occupancy network (Peng et al., ECCV 2020): points to three planes, convolutions there, a look-up."""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jax import Array
from jaxtyping import Bool, Float, Int

from eval.peers.learned.clouds import Centered, about_vertical
from eval.peers.learned.occupancy_network import OccupancyNetwork
from train.shards.sampling import TrainingSample

CELLS = 32  # a side of a plane; published: 64
CHANNELS = 16  # of a plane; published: 32
AXES = ((0, 1), (0, 2), (1, 2))  # of the three planes
MARGIN = 1.4  # the planes reach this far beyond the cloud's longest half edge: one view shows no back
FAR = 1e9

Plane = Float[Array, "cells cells c"]


def boxed(points: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Centered:
    """A cloud about the middle of its box, its longest half edge with its margin the unit."""
    low = jnp.where(mask[:, None], points, FAR).min(axis=0)
    high = jnp.where(mask[:, None], points, -FAR).max(axis=0)
    middle, half = (low + high) / 2, jnp.maximum((high - low).max() / 2, 1e-9) * MARGIN
    inside = jnp.where(mask[:, None], (points - middle) / half, 0.0)
    return Centered(points=inside, mask=mask, mean=middle, radius=half)


def cell_of(points: Float[Array, "n 3"], axes: tuple[int, int]) -> Int[Array, " n"]:
    """The cell of a plane that each point of [−1, 1]³ falls into; those outside fall into the border."""
    at = jnp.clip(jnp.floor((points[:, axes] + 1) / 2 * CELLS), 0, CELLS - 1).astype(int)
    return at[:, 0] * CELLS + at[:, 1]


def cell_means(
    features: Float[Array, "n c"], cell: Int[Array, " n"], mask: Bool[Array, " n"]
) -> Float[Array, "cells2 c"]:
    """Mean of the features in every cell, zeros where it is empty."""
    total = jnp.zeros((CELLS**2, features.shape[1])).at[cell].add(jnp.where(mask[:, None], features, 0.0))
    count = jnp.zeros(CELLS**2).at[cell].add(mask.astype(features.dtype))
    return total / jnp.maximum(count, 1)[:, None]


def looked_up(plane: Plane, points: Float[Array, "q 3"], axes: tuple[int, int]) -> Float[Array, "q c"]:
    """Bilinear between the middles of cells; beyond the border, its value."""
    at = jnp.clip((points[:, axes] + 1) / 2 * CELLS - 0.5, 0.0, CELLS - 1.0)
    low = jnp.clip(jnp.floor(at), 0, CELLS - 2).astype(int)
    part = at - low
    found = jnp.zeros((len(points), plane.shape[-1]))
    for i in (0, 1):
        for j in (0, 1):
            weight = (part[:, 0] if i else 1 - part[:, 0]) * (part[:, 1] if j else 1 - part[:, 1])
            found += weight[:, None] * plane[low[:, 0] + i, low[:, 1] + j]
    return found


class LocalPointNet(nn.Module):
    """A feature a point, which sees the mean of its cells between the layers (published: the maximum)."""

    @nn.compact
    def __call__(self, points: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Float[Array, "n c"]:
        cells = [cell_of(points, axes) for axes in AXES]
        x = nn.relu(nn.Dense(2 * CHANNELS)(points))
        for _ in range(3):
            pooled = jnp.zeros_like(x)
            for cell in cells:
                pooled += cell_means(x, cell, mask)[cell]
            x = nn.relu(nn.Dense(2 * CHANNELS)(jnp.concatenate([x, pooled], axis=-1)))
        return nn.Dense(CHANNELS)(x)


class PlaneNet(nn.Module):
    """A U-Net of three sizes, shared by the planes."""

    @nn.compact
    def __call__(self, planes: Float[Array, "3 cells cells c"]) -> Float[Array, "3 cells cells c"]:
        def block(x: Array, width: int) -> Array:
            return nn.relu(nn.Conv(width, (3, 3))(x))

        whole = block(planes, CHANNELS)
        half = block(nn.avg_pool(whole, (2, 2), (2, 2)), 2 * CHANNELS)
        quarter = block(block(nn.avg_pool(half, (2, 2), (2, 2)), 3 * CHANNELS), 3 * CHANNELS)
        half = block(jnp.concatenate([half, doubled(quarter)], axis=-1), 2 * CHANNELS)
        return nn.Conv(CHANNELS, (3, 3))(jnp.concatenate([whole, doubled(half)], axis=-1))


def doubled(planes: Float[Array, "b i j c"]) -> Float[Array, "b 2*i 2*j c"]:
    """Every cell four times."""
    return jnp.repeat(jnp.repeat(planes, 2, axis=1), 2, axis=2)


class ConvONet(OccupancyNetwork):
    """A cloud to a field of occupancy; the planes stand upright, so it is trained on turns about the vertical."""

    hidden: ClassVar[int] = 64  # published: 32
    depth: ClassVar[int] = 3  # published: 5

    def setup(self) -> None:
        super().setup()
        self.points, self.planes = LocalPointNet(), PlaneNet()

    def code(
        self, points: Float[Array, "n 3"], mask: Bool[Array, " n"]
    ) -> tuple[Float[Array, "3 cells cells c"], Centered]:
        """Three planes of features, and the box they span."""
        cloud = boxed(points, mask)
        x = self.points(cloud.points, mask)
        means = [cell_means(x, cell_of(cloud.points, axes), mask) for axes in AXES]
        return self.planes(jnp.stack(means).reshape(3, CELLS, CELLS, -1)), cloud

    def field(
        self, code: tuple[Float[Array, "3 cells cells c"], Centered], queries: Float[Array, "q 3"]
    ) -> Float[Array, " q"]:
        """Logits at points of the cloud's frame."""
        planes, cloud = code
        at = cloud.local(queries)
        feature = sum((looked_up(p, at, axes) for p, axes in zip(planes, AXES, strict=True)), jnp.zeros(()))
        return self.decoded(at, feature)


def upright_occupancy_loss(
    network: nn.Module, params: Any, sample: TrainingSample, key: Array
) -> Float[Array, ""]:
    """Cross-entropy of inside and outside, every shape turned about the vertical by chance."""
    angles = jax.random.uniform(key, (len(sample.points),), maxval=2 * jnp.pi)
    R = jax.vmap(about_vertical)(angles)
    points, queries = (jnp.einsum("bij,bcnj->bcni", R, x) for x in (sample.points, sample.queries))
    logits = jax.vmap(jax.vmap(partial(network.apply, params)))(points, sample.mask, queries)
    return optax.sigmoid_binary_cross_entropy(jnp.asarray(logits), sample.sdf < 0).mean()
