"""RPM-Net (Yew and Lee, CVPR 2020): features of point pairs, soft correspondences, a few iterations."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from eval.peers.learned.clouds import about_vertical, centered
from eval.peers.learned.sinkhorn import sinkhorn
from more2_jax.geometry.points import kabsch
from more2_jax.network.vector_neurons import nearest_points
from more2_jax.registration.starting_poses import yaw_of
from train.shards.sampling import TrainingSample

NEIGHBORS = 12  # published: those within a radius, 64 at most
FEATURES = 64  # published: 96
SINKHORN_STEPS = 5
TRAINING_ROUNDS, ROUNDS = 2, 5  # as published
# A point has a partner where the other cloud is nearer than this, in its radii. Clouds hold 128 points.
PARTNER = 0.2
MATCH_WEIGHT = 0.1  # of the cross-entropy of correspondences, which the published loss has not
INLIER_WEIGHT = 0.01  # as published
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
    index = jnp.where(real, index, index[:, :1])  # fewer points than neighbors: the nearest again
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

    def _partners(self, one: Array, other: Array, one_mask: Array, other_mask: Array, k: int) -> Array:
        k = min(k, TRAINING_ROUNDS - 1)
        squared = 2.0 - 2.0 * one @ other.T
        scores = -nn.softplus(self.sharpness[k]) * (squared - nn.softplus(self.unlike[k]))
        return sinkhorn(scores, one_mask, other_mask, SINKHORN_STEPS)


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


def registration_loss(
    network: nn.Module, params: Any, sample: TrainingSample, key: Array
) -> Float[Array, ""]:
    """How far points land from where they belong, after every round; and the cross-entropy of their partners.

    Two clouds of a shape, one of them turned about the vertical by chance.
    """
    angles = jax.random.uniform(key, (len(sample.points),), maxval=2 * jnp.pi)
    return jax.vmap(partial(pair_loss, network, params))(sample.points, sample.mask, angles).mean()


def pair_loss(
    network: nn.Module,
    params: Any,
    points: Float[Array, "2 n 3"],
    mask: Bool[Array, "2 n"],
    turn: Float[Array, ""],
) -> Float[Array, ""]:
    """The loss of one pair of clouds that lie in one frame, before the first is turned."""
    target, unturned = centered(points[1], mask[1]), centered(points[0], mask[0])
    there = target.local(points[0])  # where source points belong
    here = jnp.where(mask[0][:, None], unturned.points * unturned.radius / target.radius, 0.0)
    source = here @ about_vertical(turn).T
    given = source, mask[0], target.points, mask[1]
    found: Any = network.apply(params, *given)
    poses, partners = found
    landed = jax.vmap(lambda T: source @ T[:3, :3].T + T[:3, 3])(poses)
    error = jnp.where(mask[0][:, None], jnp.abs(landed - there), 0.0).sum(axis=(1, 2)) / mask[0].sum()
    later = 0.5 ** jnp.arange(len(poses) - 1, -1, -1)
    unmatched = 1.0 - jnp.exp(partners[:, :-1, :-1]).sum(axis=-1)
    idle = jnp.where(mask[0], unmatched, 0.0).sum(axis=-1) / mask[0].sum()
    unlike = jax.vmap(partial(partner_loss, there, target.points, mask[0], mask[1]))(partners)
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
