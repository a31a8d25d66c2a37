"""What networks of occupancy share: a decoder whose residual blocks each see the code (Mescheder et al., CVPR 2019)."""

from __future__ import annotations

from typing import Any, ClassVar

import flax.linen as nn
from jax import Array
from jaxtyping import Bool, Float


class ResidualBlock(nn.Module):
    """Two layers beside a shortcut (ResnetBlockFC)."""

    hidden: int

    @nn.compact
    def __call__(self, x: Float[Array, "q h"]) -> Float[Array, "q h"]:
        return x + nn.Dense(self.hidden)(nn.relu(nn.Dense(self.hidden)(nn.relu(x))))


class OccupancyNetwork(nn.Module):
    """A cloud to a field of occupancy. Networks say what their code is, and what of it a query sees."""

    hidden: ClassVar[int]
    depth: ClassVar[int]  # residual blocks

    def setup(self) -> None:
        self.query = nn.Dense(self.hidden)
        self.blocks = [ResidualBlock(self.hidden) for _ in range(self.depth)]
        self.codes = [nn.Dense(self.hidden) for _ in range(self.depth)]
        self.last = nn.Dense(1)

    def __call__(
        self, points: Float[Array, "n 3"], mask: Bool[Array, " n"], queries: Float[Array, "q 3"]
    ) -> Float[Array, " q"]:
        """Logits of being inside, at points of the cloud's frame."""
        return self.field(self.code(points, mask), queries)

    def code(self, points: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Any:
        """What `field` needs to know of a cloud."""
        raise NotImplementedError

    def field(self, code: Any, queries: Float[Array, "q 3"]) -> Float[Array, " q"]:
        """Logits at points of the cloud's frame."""
        raise NotImplementedError

    def decoded(self, asked: Float[Array, "q i"], known: Float[Array, "*q c"]) -> Float[Array, " q"]:
        """Logits of queries, from what says where they are and what is known there."""
        x = self.query(asked)
        for block, own in zip(self.blocks, self.codes, strict=True):
            x = block(x + own(known))
        return self.last(nn.relu(x))[:, 0]
