"""GeoTransformer (Qin et al., CVPR 2022): superpoints matched by attention, their points by optimal transport.

No starts, no iterations: patches that look alike give a pose each, and the one that most partners agree with is taken.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
import optax
from jax import Array
from jaxtyping import Bool, Float, Int

from eval.peers.learned.geometric_attention import FAR, WIDTH, Attention, Geometry
from eval.peers.learned.local_to_global import local_to_global, mutual
from eval.peers.learned.pair_features import Oriented, oriented, pair_features
from eval.peers.learned.patches import SUPERPOINTS, Patches, overlap, patches_of
from eval.peers.learned.sinkhorn import sinkhorn
from eval.peers.learned.training_pairs import turned_pair, turns
from train.shards.sampling import TrainingSample

BLOCKS = 2  # of self- and cross-attention; published: 3
PAIRS = 24  # of patches; published: 128 in training, 256 after it
TEMPERATURE = 0.1  # of superpoints' cosines
SINKHORN_STEPS = 20  # published: 100
PARTNER = 0.15  # a point has a partner where the other cloud is nearer than this, in its radii


class PointNetwork(nn.Module):
    """A feature a point, of its neighbors and of theirs, which turning about the vertical does not change."""

    @nn.compact
    def __call__(self, cloud: Oriented) -> Float[Array, "n w"]:
        pairs = pair_features(cloud)
        height, up = cloud.points[:, 2], cloud.normals[:, 2]
        rise = height[cloud.neighbors] - height[:, None]
        edge = jnp.concatenate([pairs, rise[..., None], up[cloud.neighbors][..., None]], axis=-1)
        x = jnp.stack([height, up, jnp.hypot(cloud.points[:, 0], cloud.points[:, 1])], axis=-1)
        for _ in range(2):
            # Of a layer on both ends and the edge, the ends' products are made once a point, not once an edge.
            around = nn.Dense(WIDTH)(edge) + nn.Dense(WIDTH)(x)[:, None] + nn.Dense(WIDTH)(x)[cloud.neighbors]
            x = nn.LayerNorm()(nn.Dense(WIDTH)(nn.relu(around).max(axis=1)))
        return x


@flax.struct.dataclass
class Described:
    """A cloud with its patches, and what is known of its points and superpoints."""

    points: Float[Array, "n 3"]
    patches: Patches
    dense: Float[Array, "n w"]
    coarse: Float[Array, "s w"]  # unit, after all attention


class GeoTransformer(nn.Module):
    """Two clouds about their means, in one unit, to the pose between them."""

    def setup(self) -> None:
        self.points, self.geometry = PointNetwork(), Geometry()
        self.own = [Attention() for _ in range(BLOCKS)]
        self.across = [Attention() for _ in range(BLOCKS)]
        self.coarse, self.dense = nn.Dense(WIDTH), nn.Dense(WIDTH)
        self.alone = self.param("alone", nn.initializers.constant(1.0), ())  # score of having no partner

    def __call__(
        self,
        source: Float[Array, "n 3"],
        source_mask: Bool[Array, " n"],
        target: Float[Array, "m 3"],
        target_mask: Bool[Array, " m"],
    ) -> tuple[Described, Described]:
        """Both clouds, each described in the light of the other."""
        masks = source_mask, target_mask
        clouds = [oriented(points, mask) for points, mask in ((source, source_mask), (target, target_mask))]
        dense = [self.points(c) for c in clouds]
        patches = [patches_of(c.points, mask) for c, mask in zip(clouds, masks, strict=True)]
        x, y = (d[:SUPERPOINTS] for d in dense)
        (p, q), (g, h) = patches, [self.geometry(p.centers, p.mask) for p in patches]
        for own, across in zip(self.own, self.across, strict=True):
            x, y = own(x, x, p.mask, g), own(y, y, q.mask, h)
            x, y = across(x, y, q.mask), across(y, x, p.mask)
        parts = zip(clouds, patches, dense, (x, y), strict=True)
        a, b = (
            Described(points=c.points, patches=p, dense=self.dense(d), coarse=unit(self.coarse(z)))
            for c, p, d, z in parts
        )
        return a, b

    def partners(self, a: Described, b: Described, pair: Int[Array, "k 2"]) -> Float[Array, "k p+1 p+1"]:
        """Logarithms of how much points of pairs of patches belong together; the last are for those with no partner."""

        def one(i: Array, j: Array) -> Array:
            (rows, real), (columns, there) = (
                (d.patches.members[k], d.patches.real[k]) for d, k in ((a, i), (b, j))
            )
            scores = a.dense[rows] @ b.dense[columns].T / WIDTH**0.5 - self.alone
            return sinkhorn(scores, real, there, SINKHORN_STEPS)

        return jax.vmap(one)(*pair.T)

    def pose(
        self, source: Array, source_mask: Array, target: Array, target_mask: Array, upright: bool
    ) -> Float[Array, "4 4"]:
        """`T_target_source`; with `upright`, a turn about z."""
        a, b = self(source, source_mask, target, target_mask)
        pair = likeliest(likeness(a, b), PAIRS)
        weight = mutual(jnp.exp(self.partners(a, b, pair)[:, :-1, :-1]))
        source, target = (d.points[d.patches.members[pair[:, k]]] for k, d in enumerate((a, b)))
        return local_to_global(source, target, weight, upright)


def unit(x: Float[Array, "s w"]) -> Float[Array, "s w"]:
    """Every row of length 1."""
    return x / jnp.sqrt(jnp.sum(x**2, axis=-1, keepdims=True) + 1e-12)


def likeness(a: Described, b: Described) -> Float[Array, "s t"]:
    """Of superpoints, each held against all that either could be matched with (the published dual normalization)."""
    both = a.patches.mask[:, None] & b.patches.mask
    scores = jnp.where(both, a.coarse @ b.coarse.T / TEMPERATURE, -FAR)
    return jnp.where(both, nn.softmax(scores, axis=0) * nn.softmax(scores, axis=1), 0.0)


def likeliest(score: Float[Array, "s t"], count: int) -> Int[Array, "count 2"]:
    """Rows and columns of the highest scores."""
    at = jax.lax.top_k(score.reshape(-1), count)[1]
    return jnp.stack(jnp.divmod(at, score.shape[1]), axis=-1)


def superpoint_loss(network: nn.Module, params: Any, sample: TrainingSample, key: Array) -> Float[Array, ""]:
    """Cross-entropies of superpoints and of points with their true partners; one cloud of a pair is turned."""
    keys = jax.random.split(key, len(sample.points) + 1)
    angles = turns(keys[0], len(sample.points))
    return jax.vmap(partial(pair_loss, network, params))(sample.points, sample.mask, angles, keys[1:]).mean()


def pair_loss(
    network: nn.Module,
    params: Any,
    points: Float[Array, "2 n 3"],
    mask: Bool[Array, "2 n"],
    turn: Float[Array, ""],
    key: Array,
) -> Float[Array, ""]:
    """The loss of one pair of clouds that lie in one frame, before the first is turned."""
    made = turned_pair(points, mask, turn)
    described: Any = network.apply(params, made.source, mask[0], made.target, mask[1])
    a, b = described
    squared = jnp.sum((made.there[:, None] - made.target) ** 2, axis=-1)
    partner = mask[0][:, None] & mask[1] & (squared < PARTNER**2)
    shared = overlap(partner, a.patches, b.patches), overlap(partner.T, b.patches, a.patches)
    # Of the pairs that overlap, some by chance: as published, the finer half does not wait for the coarser one.
    chance = jax.random.uniform(key, shared[0].shape)
    pair = likeliest(jnp.where(shared[0] > 0, chance, -1.0), PAIRS)
    found: Any = network.apply(params, a, b, pair, method="partners")
    truth = jax.vmap(partial(true_partners, partner, a.patches, b.patches))(pair)
    truth *= (shared[0] > 0)[pair[:, 0], pair[:, 1], None, None]
    fine = -jnp.sum(truth * jnp.maximum(found, -20.0)) / jnp.maximum(truth.sum(), 1.0)
    scores = jnp.where(b.patches.mask, a.coarse @ b.coarse.T / TEMPERATURE, -FAR)
    back = jnp.where(a.patches.mask, b.coarse @ a.coarse.T / TEMPERATURE, -FAR)
    return fine + (coarse_loss(scores, shared[0]) + coarse_loss(back, shared[1])) / 2


def true_partners(
    partner: Bool[Array, "n m"], a: Patches, b: Patches, pair: Int[Array, "2"]
) -> Float[Array, "p+1 p+1"]:
    """1 where points of two patches belong together, and in the slack of those that have none in the other patch."""
    rows, columns = a.members[pair[0]], b.members[pair[1]]
    real, there = a.real[pair[0]], b.real[pair[1]]
    both = partner[rows][:, columns] & real[:, None] & there
    alone, left = real & ~both.any(axis=1), there & ~both.any(axis=0)
    whole = jnp.block([[both, alone[:, None]], [left[None], jnp.zeros((1, 1), bool)]])
    return whole.astype(jnp.float32)


def coarse_loss(scores: Float[Array, "s t"], shared: Float[Array, "s t"]) -> Float[Array, ""]:
    """Cross-entropy of superpoints with those they overlap, by how much; of those that overlap any."""
    total = shared.sum(axis=1)
    wanted = shared / jnp.maximum(total, 1e-9)[:, None]
    entropy = optax.softmax_cross_entropy(scores, wanted)
    return jnp.where(total > 0, entropy, 0.0).sum() / jnp.maximum((total > 0).sum(), 1)
