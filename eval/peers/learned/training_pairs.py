"""What networks of registration train on: two clouds of a shape, one of them turned about the vertical."""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from eval.peers.learned.clouds import about_vertical, centered


@flax.struct.dataclass
class TurnedPair:
    """Two clouds about their means, in the target's radii; rows that are not real are 0 in `source` and `target`."""

    source: Float[Array, "n 3"]
    target: Float[Array, "n 3"]
    there: Float[Array, "n 3"]  # where the source's points belong


def turns(key: Array, count: int) -> Float[Array, " count"]:
    """So many turns about the vertical, radians, all alike likely."""
    return jax.random.uniform(key, (count,), maxval=2 * jnp.pi)


def turned_pair(
    points: Float[Array, "2 n 3"], mask: Bool[Array, "2 n"], turn: Float[Array, ""]
) -> TurnedPair:
    """The pair that two clouds in one frame make when the first is turned."""
    target, unturned = centered(points[1], mask[1]), centered(points[0], mask[0])
    here = jnp.where(mask[0][:, None], unturned.points * unturned.radius / target.radius, 0.0)
    return TurnedPair(
        source=here @ about_vertical(turn).T, target=target.points, there=target.local(points[0])
    )
