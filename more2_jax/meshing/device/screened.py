"""The screened Poisson equation of `meshing.screened_poisson` on one fixed cube: a product in Fourier space."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float
from scipy.fft import next_fast_len

from more2_jax.meshing.device.lattice import in_cells
from more2_jax.meshing.device.rows import masked_median
from more2_jax.meshing.extract import HALF_WIDTH
from more2_jax.meshing.screened_poisson import TRANSITION_CELLS

Grid = Float[Array, "i j k"]


def screened_poisson(
    field: Grid,
    points: Float[Array, "n 3"],
    mask: Bool[Array, " n"],
    normals: Float[Array, "n 3"],
    area: Float[Array, " n"],
    half_width: Float[Array, ""],
    step: Float[Array, ""],
    length: Float[Array, ""],
    margin: float,
) -> Grid:
    """The field on a cube, inside and outside corrected near points; canonical units.

    `step` is that of the grid as sharp as the points have something to tell; the cube's may be half of it.
    `margin`: empty space around, for the transform takes the box as periodic.
    """
    cells = len(field) - 1
    space = cells + 1 + int(np.ceil(margin * cells / (2 * HALF_WIDTH)))
    size = next_fast_len(space, real=True) or space
    own = 2 * half_width / cells
    x, y, z = wavenumbers(size, own)
    squared = x**2 + y**2 + z**2
    prior = jnp.clip(0.5 - field / (2 * TRANSITION_CELLS * step), 0.0, 1.0)
    width = jnp.maximum(step, jnp.sqrt(jnp.maximum(masked_median(area, mask), 1e-12)))
    flux = splat(points, mask, -area[:, None] * normals, cells, half_width)
    along = [jnp.fft.rfftn(f, s=(size,) * 3) * k for f, k in zip(flux, (x, y, z), strict=True)]
    # Points that share corners of cells as large as `step` are spread by so much more.
    variance = width**2 + (step**2 - own**2) / 6
    divergence = 1j * sum(along) * jnp.exp(-0.5 * variance * squared)
    smooth = jnp.fft.rfftn(prior, s=(size,) * 3) * squared * jnp.exp(-0.5 * step**2 * squared)
    change = jnp.fft.irfftn((smooth + divergence) / (squared + length**-2.0), s=(size,) * 3)
    change = change[: cells + 1, : cells + 1, : cells + 1]
    return (0.5 - prior + change) * 2 * TRANSITION_CELLS * step


def wavenumbers(size: int, step: Float[Array, ""]) -> list[Array]:
    """Along each axis of a real transform's result, to be broadcast."""
    full, half = jnp.fft.fftfreq(size), jnp.fft.rfftfreq(size)
    return [2 * jnp.pi * k / step for k in (full[:, None, None], full[:, None], half)]


def splat(
    points: Float[Array, "n 3"],
    mask: Bool[Array, " n"],
    values: Float[Array, "n c"],
    cells: int,
    half_width: Float[Array, ""],
) -> Float[Array, "c i j k"]:
    """Densities of `values` at points, shared by the eight corners of their cells; none of points outside."""
    flat, offset = in_cells(points, mask, cells, half_width)
    weight = (1 - jnp.abs(offset)).prod(axis=2) * (cells / (2 * half_width)) ** 3
    shape, shares = (cells + 1,) * 3, weight[..., None] * values[:, None]
    return jnp.stack(
        [
            jnp.zeros((cells + 1) ** 3).at[flat].add(shares[..., i], mode="drop").reshape(shape)
            for i in range(values.shape[1])
        ]
    )
