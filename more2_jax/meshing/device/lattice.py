"""A cube of corners, its edge part of the data: places, linear interpolation, and the nearest point of every corner."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from more2_jax.geometry.points import nearest_index
from more2_jax.meshing.device.rows import at_rows
from more2_jax.meshing.screened_poisson import CELL_CORNERS

COARSEST = 16  # cells of the first lattice at most: there every point is compared with every corner
KEY_BITS = 14  # of a point's row, beside its distance: 16,384 points
PASSES = 3  # in which a corner hears of its six neighbors' nearest points, on every lattice

Grid = Float[Array, "i j k"]
Numbers = Int[Array, "i j k"]


def axis_places(cells: int, half_width: Float[Array, ""]) -> Float[Array, " c"]:
    """Where the corners of a cube of `cells` a side lie along each axis."""
    return half_width * (2.0 * jnp.arange(cells + 1) / cells - 1.0)


def corners(cells: int, half_width: Float[Array, ""]) -> Float[Array, "c 3"]:
    """All corners, the last axis fastest."""
    axis = axis_places(cells, half_width)
    return jnp.stack(jnp.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)


def upsampled(x: Grid) -> Float[Array, "2*i-1 2*j-1 2*k-1"]:
    """Linear interpolation to half the step."""
    for axis in range(3):
        low, high = (jax.lax.slice_in_dim(x, a, x.shape[axis] - 1 + a, axis=axis) for a in (0, 1))
        pairs = jnp.stack([low, (low + high) / 2], axis=axis + 1)
        pairs = pairs.reshape(*x.shape[:axis], -1, *x.shape[axis + 1 :])
        last = jax.lax.slice_in_dim(x, x.shape[axis] - 1, x.shape[axis], axis=axis)
        x = jnp.concatenate([pairs, last], axis=axis)
    return x


def in_cells(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"], cells: int, half_width: Float[Array, ""]
) -> tuple[Int[Array, "n 8"], Float[Array, "n 8 3"]]:
    """Of every point the eight corners of its cell, flat, and how far it lies from each, in steps.

    Corners that are not there, and those of points that are none, have a number beyond the last.
    """
    place = (points + half_width) * (cells / (2 * half_width))
    at = jnp.floor(jax.lax.stop_gradient(place)).astype(jnp.int32)[:, None] + CELL_CORNERS
    held = mask[:, None] & ((at >= 0) & (at <= cells)).all(axis=2)
    flat = (at[..., 0] * (cells + 1) + at[..., 1]) * (cells + 1) + at[..., 2]
    return jnp.where(held, flat, (cells + 1) ** 3), place[:, None] - at


def nearest_on_lattice(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"], cells: int, half_width: Float[Array, ""]
) -> Numbers:
    """The row of the point nearest to every corner of a cube, seldom the second nearest.

    Of few corners by comparing all; then from coarse to fine. On a lattice a corner knows the points of its own cells,
    what the coarser one found, and what its neighbors know ("jump flooding", Rong and Tan, 2006).
    """
    points, half_width = jax.lax.stop_gradient((points, half_width))
    coarsest = cells
    while coarsest > COARSEST and coarsest % 2 == 0:
        coarsest //= 2
    found = nearest_index(corners(coarsest, half_width), points, mask).reshape((coarsest + 1,) * 3)
    while coarsest < cells:
        coarsest *= 2
        for axis in range(3):
            found = jnp.repeat(found, 2, axis=axis)
        found = found[:-1, :-1, :-1]
        found = spread(points, found, own_points(points, mask, coarsest, half_width), coarsest, half_width)
    return found


def own_points(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"], cells: int, half_width: Float[Array, ""]
) -> Numbers:
    """The nearest point of the cells around every corner; 0 where there is none."""
    flat, offset = in_cells(points, mask, cells, half_width)
    low, most = (1 << KEY_BITS) - 1, np.iinfo(np.int32).max
    near = ((offset**2).sum(axis=2) / 3 * (1 << (30 - KEY_BITS))).astype(jnp.int32) << KEY_BITS
    key = jnp.full((cells + 1) ** 3, most).at[flat].min(near | jnp.arange(len(points))[:, None], mode="drop")
    return jnp.where(key < most, key & low, 0).reshape((cells + 1,) * 3)


def spread(
    points: Float[Array, "n 3"], found: Numbers, other: Numbers, cells: int, half_width: Float[Array, ""]
) -> Numbers:
    """The nearest of two points and of what neighbors know; from the far side of the cube comes just another point."""
    axis = axis_places(cells, half_width)

    def squared(index: Numbers) -> Grid:
        p = at_rows(points, index)
        return (
            (p[..., 0] - axis[:, None, None]) ** 2
            + (p[..., 1] - axis[:, None]) ** 2
            + (p[..., 2] - axis) ** 2
        )

    def nearer(best: tuple[Grid, Numbers], index: Numbers) -> tuple[Grid, Numbers]:
        distance = squared(index)
        return jnp.minimum(best[0], distance), jnp.where(distance < best[0], index, best[1])

    def heard(_: Array, best: tuple[Grid, Numbers]) -> tuple[Grid, Numbers]:
        for axis, way in itertools.product(range(3), (1, -1)):
            best = nearer(best, jnp.roll(best[1], way, axis=axis))
        return best

    best = nearer((squared(found), found), other)
    return jax.lax.fori_loop(0, PASSES, heard, best)[1]
