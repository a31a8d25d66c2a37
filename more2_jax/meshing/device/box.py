"""The box around what is inside or was seen: beyond, as `GridField.around` on the host, there is no surface."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

Grid = Float[Array, "i j k"]


def in_box(
    field: Grid,
    points: Float[Array, "n 3"],
    mask: Bool[Array, " n"],
    cells: int,
    half_width: Float[Array, ""],
    margin: float,
) -> Bool[Array, "r r r"]:
    """Which corners of a cube of `cells` a side lie in the box of a coarser grid's corners, and a margin around it.

    That box holds the corners where the coarse field is negative, and the points.
    """
    coarse = len(field) - 1
    around = jnp.ceil(margin * coarse / (2 * half_width)) + 1
    corner = jnp.rint((points + half_width) * (coarse / (2 * half_width)))
    inside = [(field < 0).any(axis=tuple(j for j in range(3) if j != i)) for i in range(3)]
    kept = []
    for axis, negative in enumerate(inside):
        number = jnp.arange(coarse + 1)
        low = jnp.where(mask, corner[:, axis] - 1, jnp.inf).min()
        high = jnp.where(mask, corner[:, axis] + 1, -jnp.inf).max()
        low = jnp.minimum(low, jnp.where(negative, number, jnp.inf).min())
        high = jnp.maximum(high, jnp.where(negative, number, -jnp.inf).max())
        place = np.arange(cells + 1) * (coarse / cells)
        kept.append((place >= low - around) & (place <= high + around))
    return kept[0][:, None, None] & kept[1][:, None] & kept[2]
