"""VN-ONet (Deng et al., Vector Neurons, ICCV 2021): occupancy asked by products that do not change by turning."""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jax import Array
from jaxtyping import Bool, Float

from eval.peers.learned.clouds import Centered, centered
from eval.peers.learned.occupancy_network import OccupancyNetwork
from eval.peers.learned.vn_dgcnn import GRAPH, GraphVectors, Invariants
from more2_jax.config import EncoderConfig
from more2_jax.network.vector_neurons import channel_normalize, masked_mean
from train.shards.sampling import TrainingSample


class VNONet(OccupancyNetwork):
    """A cloud to a field of occupancy that turns, moves and scales along with it."""

    config: EncoderConfig = GRAPH
    hidden: ClassVar[int] = 128  # published: 256
    depth: ClassVar[int] = 3  # published: 5

    def setup(self) -> None:
        super().setup()
        self.graph, self.invariants = GraphVectors(self.config), Invariants(self.config.leak)

    def code(
        self, points: Float[Array, "n 3"], mask: Bool[Array, " n"]
    ) -> tuple[Float[Array, "3 c"], Centered]:
        """Vectors of unit mean length that turn with the cloud, and where it lies."""
        cloud = centered(points, mask)
        vectors, left = self.graph(cloud.points, cloud.mask)
        return channel_normalize(masked_mean(vectors, left)) * self.config.code**0.5, cloud

    def unit_code(self, points: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Float[Array, " k"]:
        """What a cloud is matched by: its invariants at unit length, unchanged by turning, moving and scaling it."""
        x = self.invariants(self.code(points, mask)[0])
        return x / jnp.sqrt(jnp.sum(x * x) + 1e-12)

    def field(
        self, code: tuple[Float[Array, "3 c"], Centered], queries: Float[Array, "q 3"]
    ) -> Float[Array, " q"]:
        """Logits at points of the cloud's frame: of ‖q‖², ⟨q, vector⟩ and the code's invariants."""
        vectors, cloud = code
        at = cloud.local(queries)
        squared = jnp.sum(at**2, axis=-1, keepdims=True)
        return self.decoded(jnp.concatenate([at @ vectors, squared], axis=-1), self.invariants(vectors))


def occupancy_loss(network: nn.Module, params: Any, sample: TrainingSample, key: Array) -> Float[Array, ""]:
    """Cross-entropy of inside and outside, both clouds of every shape."""
    of_cloud = jax.vmap(jax.vmap(partial(network.apply, params)))
    logits = of_cloud(sample.points, sample.mask, sample.queries)
    return optax.sigmoid_binary_cross_entropy(jnp.asarray(logits), sample.sdf < 0).mean()
