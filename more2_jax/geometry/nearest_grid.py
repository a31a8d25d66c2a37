"""Nearest points by table: a box of cells, each naming the cloud's point nearest to its middle.

One look-up takes the place of a distance to every point: many starts of many pairs can be aligned at the price of
few. What it names is the nearest to within about a cell; where that matters, `geometry.nearest` has the exact one.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from more2_jax.geometry.points import FAR, nearest_index
from more2_jax.types import AnyArray, pytree, quantity

MARGIN = 0.1  # around the cloud, in shares of its longest edge; beyond, the nearest cell of the box answers


@pytree
class NearestGrid:
    """The table of one cloud; the cells of an axis are as many as of the others, so a thin box has thin cells."""

    index: Int[AnyArray, "*b g g g"] = quantity("invariant")  # into the cloud's rows
    low: Float[AnyArray, "*b 3"] = quantity(
        "axis-aligned"
    )  # corner of the box, in the cloud's frame and unit
    cell: Float[AnyArray, "*b 3"] = quantity("axis-aligned")  # its size


def nearest_grid(points: Float[Array, "n 3"], mask: Bool[Array, " n"], cells: int) -> NearestGrid:
    """The table of a cloud, `cells` a side."""
    points = jax.lax.stop_gradient(points)
    low = jnp.where(mask[:, None], points, FAR).min(axis=0)
    high = jnp.where(mask[:, None], points, -FAR).max(axis=0)
    margin = MARGIN * (high - low).max() + 1e-6
    low, high = low - margin, high + margin
    cell = (high - low) / cells
    axes = [low[i] + (jnp.arange(cells) + 0.5) * cell[i] for i in range(3)]
    middles = jnp.stack(jnp.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    index = nearest_index(middles, points, mask)
    return NearestGrid(index=index.reshape(cells, cells, cells), low=low, cell=cell)


def look_up(grid: NearestGrid, points: Float[Array, "n 3"]) -> Int[Array, " n"]:
    """The row of the cloud that is nearest to the middle of every point's cell."""
    cells = len(grid.index)
    at = jnp.clip(((points - grid.low) / grid.cell).astype(jnp.int32), 0, cells - 1)
    return grid.index.reshape(-1)[(at[:, 0] * cells + at[:, 1]) * cells + at[:, 2]]
