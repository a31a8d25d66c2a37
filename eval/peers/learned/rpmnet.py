"""RPM-Net (Yew and Lee, CVPR 2020): features of point pairs, soft correspondences, a few iterations."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from eval.peers.learned.pair_features import LEAST, Oriented, oriented, pair_features
from eval.peers.learned.sinkhorn import sinkhorn
from eval.peers.learned.training_pairs import turned_pair, turns
from eval.peers.learned.weighted_pose import pose
from train.shards.sampling import TrainingSample

FEATURES = 64  # published: 96
SINKHORN_STEPS = 5
TRAINING_ROUNDS, ROUNDS = 2, 5  # as published
# A point has a partner where the other cloud is nearer than this, in its radii. Clouds hold 128 points.
PARTNER = 0.2
MATCH_WEIGHT = 0.1  # of the cross-entropy of correspondences, which the published loss has not
INLIER_WEIGHT = 0.01  # as published


class PointFeatures(nn.Module):
    """A unit feature a point: of its place, of where neighbors lie, and of pairs with them."""

    @nn.compact
    def __call__(self, cloud: Oriented) -> Float[Array, "n f"]:
        near = cloud.points[cloud.neighbors] - cloud.points[:, None]
        place = jnp.broadcast_to(cloud.points[:, None], near.shape)
        x = jnp.concatenate([place, near, pair_features(cloud)], axis=-1)
        for _ in range(2):
            x = nn.relu(nn.Dense(FEATURES)(x))
        x = nn.relu(nn.Dense(FEATURES)(x.max(axis=1)))
        x = nn.Dense(FEATURES)(x)
        return x / jnp.sqrt(jnp.sum(x * x, axis=-1, keepdims=True) + LEAST)


class RPMNet(nn.Module):
    """The pose between two clouds, from the identity: soft partners by features, then the pose they vote for."""

    def setup(self) -> None:
        self.features = PointFeatures()
        # Of every round that is trained: how sharply partners are told (β), how unlike they may be (α).
        self.sharpness = self.param("sharpness", nn.initializers.constant(8.0), (TRAINING_ROUNDS,))
        self.unlike = self.param("unlike", nn.initializers.constant(0.5), (TRAINING_ROUNDS,))

    def __call__(
        self,
        source: Float[Array, "n 3"],
        source_mask: Bool[Array, " n"],
        target: Float[Array, "n 3"],
        target_mask: Bool[Array, " n"],
        rounds: int = TRAINING_ROUNDS,
        upright: bool = False,
    ) -> tuple[Float[Array, "rounds 4 4"], Float[Array, "rounds n+1 n+1"]]:
        """`T_target_source` after every round, and logarithms of the partners it came from.

        Both clouds about their means, in one unit. With `upright`, turns about z alone.
        """
        a, b = oriented(source, source_mask), oriented(target, target_mask)
        wanted = self.features(b)
        T, found = jnp.eye(4), []
        for k in range(rounds):
            held = jax.lax.stop_gradient(T)
            R, t = held[:3, :3], held[:3, 3]
            moved = dataclasses.replace(
                a, points=jnp.where(source_mask[:, None], a.points @ R.T + t, 0.0), normals=a.normals @ R.T
            )
            partners = self._partners(self.features(moved), wanted, source_mask, target_mask, k)
            weights = jnp.exp(partners[:-1, :-1])
            total = weights.sum(axis=1)
            meant = weights @ b.points / jnp.maximum(total, LEAST)[:, None]
            T = pose(a.points, meant, jnp.where(source_mask, total, 0.0), upright)
            found.append((T, partners))
        return jnp.stack([T for T, _ in found]), jnp.stack([p for _, p in found])

    def pose(
        self, source: Array, source_mask: Array, target: Array, target_mask: Array, upright: bool
    ) -> Float[Array, "4 4"]:
        """`T_target_source` after all rounds."""
        return self(source, source_mask, target, target_mask, ROUNDS, upright)[0][-1]

    def _partners(self, one: Array, other: Array, one_mask: Array, other_mask: Array, k: int) -> Array:
        k = min(k, TRAINING_ROUNDS - 1)
        squared = 2.0 - 2.0 * one @ other.T
        scores = -nn.softplus(self.sharpness[k]) * (squared - nn.softplus(self.unlike[k]))
        return sinkhorn(scores, one_mask, other_mask, SINKHORN_STEPS)


def registration_loss(
    network: nn.Module, params: Any, sample: TrainingSample, key: Array
) -> Float[Array, ""]:
    """How far points land from where they belong, after every round; and the cross-entropy of their partners.

    Two clouds of a shape, one of them turned about the vertical by chance.
    """
    angles = turns(key, len(sample.points))
    return jax.vmap(partial(pair_loss, network, params))(sample.points, sample.mask, angles).mean()


def pair_loss(
    network: nn.Module,
    params: Any,
    points: Float[Array, "2 n 3"],
    mask: Bool[Array, "2 n"],
    turn: Float[Array, ""],
) -> Float[Array, ""]:
    """The loss of one pair of clouds that lie in one frame, before the first is turned."""
    pair = turned_pair(points, mask, turn)
    given = pair.source, mask[0], pair.target, mask[1]
    found: Any = network.apply(params, *given)
    poses, partners = found
    landed = jax.vmap(lambda T: pair.source @ T[:3, :3].T + T[:3, 3])(poses)
    error = jnp.where(mask[0][:, None], jnp.abs(landed - pair.there), 0.0).sum(axis=(1, 2)) / mask[0].sum()
    later = 0.5 ** jnp.arange(len(poses) - 1, -1, -1)
    unmatched = 1.0 - jnp.exp(partners[:, :-1, :-1]).sum(axis=-1)
    idle = jnp.where(mask[0], unmatched, 0.0).sum(axis=-1) / mask[0].sum()
    unlike = jax.vmap(partial(partner_loss, pair.there, pair.target, mask[0], mask[1]))(partners)
    return jnp.sum(later * (error + INLIER_WEIGHT * idle + MATCH_WEIGHT * unlike))


def partner_loss(
    there: Float[Array, "n 3"],
    target: Float[Array, "n 3"],
    mask: Bool[Array, " n"],
    target_mask: Bool[Array, " n"],
    partners: Float[Array, "n+1 n+1"],
) -> Float[Array, ""]:
    """Mean of minus the logarithm of how much points are given to their true partner, of those that have one."""
    squared = jnp.sum((there[:, None] - target) ** 2, axis=-1)
    squared = jnp.where(target_mask, squared, jnp.inf)
    own, has = jnp.argmin(squared, axis=1), mask & (squared.min(axis=1) < PARTNER**2)
    given = jnp.take_along_axis(partners[:-1], own[:, None], axis=1)[:, 0]
    return -jnp.where(has, jnp.maximum(given, -20.0), 0.0).sum() / jnp.maximum(has.sum(), 1)
