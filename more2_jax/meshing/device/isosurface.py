"""Marching cubes with a fixed number of rows: the surface where a grid's values change sign, closed, on the device."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from more2_jax.meshing.device.cube_table import CORNERS, EDGES, TRIANGLES
from more2_jax.meshing.device.rows import at_rows, true_places
from more2_jax.types import AnyArray, pytree, quantity

Grid = Float[Array, "n n n"]


@pytree
class IsoSurface:
    """Triangles of one surface. All there is, if neither count is more than there are rows."""

    vertices: Float[AnyArray, "*b r 3"] = quantity("position")  # in steps from the grid's first corner
    triangles: Int[AnyArray, "*b r t 3"] = quantity("invariant")  # of each crossed cell, outward; −1 fills up
    vertex_count: Int[AnyArray, "*b"] = quantity("invariant")
    cell_count: Int[AnyArray, "*b"] = quantity("invariant")  # of the cells that the surface crosses


def iso_surface(values: Grid, step: Float[Array, ""], rows: int) -> IsoSurface:
    """The surface around what is negative; a ring of outside around the grid closes it at the border.

    `rows`: so many vertices, and crossed cells, there is room for. Vertices are differentiable with respect to the
    values.
    """
    padded = jnp.pad(values, 1, constant_values=jnp.maximum(values.max(), step))
    inside, shape = padded < 0, padded.shape
    crossed = jnp.stack([crossings(inside, axis) for axis in range(3)])
    edges, counts = true_places(crossed.ravel(), rows)
    axis, node = edges // padded.size, edges % padded.size
    strides = jnp.asarray([shape[1] * shape[2], shape[2], 1], jnp.int32)
    flat = padded.ravel()
    first, second = at_rows(flat, node), at_rows(flat, jnp.minimum(node + strides[axis], padded.size - 1))
    gap = jnp.where(first != second, first - second, 1.0)
    corner = jnp.stack(jnp.unravel_index(node, shape), axis=1) - 1.0
    vertices = corner + (first / gap)[:, None] * jnp.eye(3)[axis]
    triangles, cells = cell_triangles(inside, counts - 1, rows)
    return IsoSurface(vertices=vertices, triangles=triangles, vertex_count=counts[-1], cell_count=cells)


def crossings(inside: Bool[Array, "n n n"], axis: int) -> Bool[Array, "n n n"]:
    """Where the edge that begins at a node, along an axis, changes sides; False where there is none."""
    changed = jnp.diff(inside, axis=axis)
    return jnp.pad(changed, [(0, int(i == axis)) for i in range(3)])


def cell_triangles(
    inside: Bool[Array, "n n n"], number: Int[Array, " e"], rows: int
) -> tuple[Int[Array, "r t 3"], Int[Array, ""]]:
    """Triangles of the crossed cells, and how many cells these are; `number`: of every edge's vertex."""
    shape = np.array(inside.shape)
    i, j, k = shape - 1
    bits = [
        inside[x : x + i, y : y + j, z : z + k].astype(jnp.int32) << bit
        for bit, (x, y, z) in enumerate(CORNERS)
    ]
    case = jnp.stack(bits).sum(axis=0).ravel()
    cells, counts = true_places((case > 0) & (case < 255), rows)
    node = jnp.stack(jnp.unravel_index(cells, (i, j, k)), axis=1) @ np.array(
        [shape[1] * shape[2], shape[2], 1]
    )
    offset = [axis * shape.prod() + np.ravel_multi_index(corner, shape) for axis, corner in EDGES]
    of_edges = at_rows(number, node[:, None] + np.array(offset))
    of_case = jnp.asarray(TRIANGLES)[at_rows(case, cells)]
    real = (of_case >= 0) & (jnp.arange(rows) < counts[-1])[:, None, None]
    found = jnp.take_along_axis(of_edges[:, None], jnp.maximum(of_case, 0), axis=2)
    return jnp.where(real, found, -1).astype(jnp.int32), counts[-1]
