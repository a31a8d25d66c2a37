"""Inside and outside by oriented points where there are some, by the field elsewhere: a screened Poisson equation.

Beyond the paper. The field makes one solid of a shelf and the space between its boards; the boards' own faces, seen
and oriented, know better. Poisson reconstruction (Kazhdan and Hoppe, 2013) looks for the indicator of the inside whose
gradient the points' normals are; here it is screened by the field's own indicator,

    Δχ − (χ − χ_field) / ℓ² = div V,

so that within about ℓ of seen points their normals decide, and far from any the field stays as it was. On a grid
that is a product in Fourier space.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.fft import irfftn, next_fast_len, rfftn

from more2_jax.meshing.grid import Grid, Lattice, Points

SOFT = 1.5  # cells on either side of the surface in which an indicator goes from 1 to 0
AGREE = 0.5  # cosine from which on a neighbor's normal is of the same face,
CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))  # of a cell
FLAT = 0.1  # and share of its squared distance that it may lie off that face


def screened(
    field: Grid,
    lattice: Lattice,
    points: Points,
    normals: Points,
    area: Float[np.ndarray, " p"],
    length: float,
    margin: float | None = None,
) -> Grid:
    """The field on a lattice, its sides near `points` put right; canonical units.

    `normals` are unit and outward, `area` is the share of the surface each point stands for, `length` is ℓ. The
    Fourier transform takes the box as periodic, with so much empty space between as `margin` says, by default ℓ.
    Near the surface the result is nearly a distance; `SOFT` cells away from it, it is cut off.
    """
    step, shape, margin = lattice.step, field.shape, length if margin is None else margin
    prior = np.clip(0.5 - field / (2 * SOFT * step), 0.0, 1.0)
    size = [next_fast_len(n + int(np.ceil(margin / step)), real=True) or n for n in shape]
    k = [
        2 * np.pi * f(n, step)
        for f, n in zip((np.fft.fftfreq, np.fft.fftfreq, np.fft.rfftfreq), size, strict=True)
    ]
    waves = np.meshgrid(*(x.astype(np.float32) for x in k), indexing="ij", sparse=True)
    squared = waves[0] ** 2 + waves[1] ** 2 + waves[2] ** 2
    # Both gradients as smooth as the grid can hold, or as the points are dense.
    width = max(step, np.sqrt(float(np.median(area))))
    flux = splat(points, -area[:, None] * normals, lattice)
    divergence = sum(w * transform(v, size) for w, v in zip(waves, flux, strict=True))
    change = squared * smooth(waves, step) * transform(prior, size)
    change += np.complex64(1j) * smooth(waves, width) * divergence
    change = np.asarray(irfftn(change / (squared + np.float32(length**-2)), s=size))
    return (0.5 - prior + change[tuple(map(slice, shape))]) * 2 * SOFT * step


def transform(x: Grid, size: list[int]) -> np.ndarray:
    """Fourier transform of a grid with empty space after it, single precision."""
    return np.asarray(rfftn(x.astype(np.float32), s=size))


def smooth(waves: Sequence[np.ndarray], width: float) -> np.ndarray:
    """What a Gaussian of this width leaves of waves, given their numbers along each axis."""
    x, y, z = (np.exp(np.float32(-0.5 * width**2) * w**2) for w in waves)
    return x * y * z


def splat(points: Points, values: Float[np.ndarray, "p k"], lattice: Lattice) -> list[Grid]:
    """Densities of `values` at points, shared by the eight corners of their cells; none of points outside."""
    place = (points - lattice.low) / lattice.step
    at = np.floor(place).astype(int)[:, None] + CORNERS
    weight = np.prod(1 - np.abs(at - place[:, None]), axis=2) / lattice.step**3
    held = ((at >= 0) & (at < lattice.shape)).all(axis=2)
    flat = np.ravel_multi_index(tuple(at[held].T), lattice.shape)
    share = [(weight * v[:, None])[held] for v in values.T]
    count = int(np.prod(lattice.shape))
    return [np.bincount(flat, s, minlength=count).reshape(lattice.shape) for s in share]


def areas(
    points: Points,
    normals: Points,
    distance: Float[np.ndarray, "p k"],
    near: Int[np.ndarray, "p k"],
) -> Float[np.ndarray, " p"]:
    """The share of the surface each point stands for: of the disc that holds its neighbors on the same face.

    `near` names every point's neighbors, itself among them, nearest first, `distance` how far they are.
    """
    offset = points[near] - points[:, None]
    along = np.einsum("pki,pi->pk", offset, normals) ** 2
    same = (np.einsum("pki,pi->pk", normals[near], normals) > AGREE) & (along <= FLAT * distance**2)
    return np.pi * distance[:, -1] ** 2 / np.maximum(same.sum(axis=1), 2)
