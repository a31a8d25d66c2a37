"""Inside and outside by oriented points where there are some, by the field elsewhere: a screened Poisson equation.

Not in the paper. The field makes one solid of a shelf and the space between its boards; the boards' own faces, observed
and oriented, know better. Screened Poisson reconstruction (Kazhdan and Hoppe, 2013) looks for the indicator of the
inside whose gradient the points' normals are; here it is screened by the field's own indicator,

    Δχ − (χ − χ_field) / ℓ² = div V,

so that within about ℓ of observed points their normals decide, and far from any the field stays as it was. On a grid
that is a product in Fourier space.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.fft import fft, ifft, irfft, next_fast_len, rfft

from more2_jax.meshing.grid import Grid, Lattice, Points

TRANSITION_CELLS = (
    1.5  # on either side of the surface, in which the indicator goes from 1 to 0: the grid's sharpest
)
LEAST_MARGIN = 0.12
# A neighbor lies on the same face if its normal is within 60° and at most this share of its squared distance is off the
# face: the other face of a thin board does not halve the area.
SAME_FACE_COSINE = 0.5
SAME_FACE_FLATNESS = 0.1
CELL_CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))


def empty_space(length: float) -> float:
    """Canonical units of empty space around what the periodic box holds, for an equation that reaches `length`."""
    return max(length, LEAST_MARGIN)


def screened_poisson(
    field: Grid,
    lattice: Lattice,
    points: Points,
    normals: Points,
    area: Float[np.ndarray, " p"],
    length: float,
    margin: float | None = None,
) -> Grid:
    """The field on a lattice, inside and outside corrected near `points`; canonical units.

    `normals` are unit and outward, `area` is the share of the surface each point stands for, `length` is ℓ. The
    Fourier transform takes the box as periodic, with so much empty space between as `margin` says, by default ℓ.
    Near the surface the result is nearly a distance; `TRANSITION_CELLS` away from it, it is cut off.
    """
    step, shape, margin = lattice.step, field.shape, length if margin is None else margin
    prior = np.clip(0.5 - field / (2 * TRANSITION_CELLS * step), 0.0, 1.0)
    size = [next_fast_len(n + int(np.ceil(margin / step)), real=True) or n for n in shape]
    k = [
        2 * np.pi * f(n, step)
        for f, n in zip((np.fft.fftfreq, np.fft.fftfreq, np.fft.rfftfreq), size, strict=True)
    ]
    x, y, z = np.meshgrid(*(x.astype(np.float32) for x in k), indexing="ij", sparse=True)
    squared = x**2 + (y**2 + z**2)
    # Both gradients as smooth as the grid can hold, or as the points are dense.
    width = max(step, np.sqrt(float(np.median(area))))
    flux = [fourier(v, size) for v in splat(points, -area[:, None] * normals, lattice)]
    # What the first axis has no part in is added up before it is transformed: one transform less.
    flux[1] *= y
    flux[1] += flux[2] * z
    divergence = along_first(flux[0], size) * x + along_first(flux[1], size)
    change = along_first(fourier(prior, size), size)
    change *= squared
    times_gaussian(change, (x, y, z), step)
    times_gaussian(divergence, (x, y, z), width)
    change += np.complex64(1j) * divergence
    change /= squared + np.float32(length**-2)
    return (0.5 - prior + inverse(change, size, shape)) * 2 * TRANSITION_CELLS * step


def fourier(x: Grid, size: Sequence[int]) -> np.ndarray:
    """Fourier transform along a grid's last two axes, with empty space after it to `size`, single precision.

    The first axis is still to be transformed (`along_first`). Lines and slices of zeros are left out: near a surface,
    most of a box is empty.
    """
    lines = np.any(x != 0, axis=2)
    found = np.zeros((len(x), size[1], size[2] // 2 + 1), np.complex64)
    if lines.any():
        found[:, : x.shape[1]][lines] = np.asarray(rfft(x[lines].astype(np.float32), n=size[2], axis=1))
        slices = np.flatnonzero(lines.sum(axis=1))
        found[slices] = np.asarray(fft(found[slices], axis=1, overwrite_x=True))
    return found


def along_first(x: np.ndarray, size: Sequence[int]) -> np.ndarray:
    """Fourier transform along the first axis, with empty space after it."""
    return np.asarray(fft(x, n=size[0], axis=0))


def inverse(x: np.ndarray, size: Sequence[int], shape: tuple[int, ...]) -> Grid:
    """The grid of `shape` that a Fourier transform of `size` is of; the empty space after it is not made."""
    x = np.asarray(ifft(x, axis=0, overwrite_x=True))[: shape[0]]
    x = np.asarray(ifft(x, axis=1))[:, : shape[1]]
    return np.asarray(irfft(x, n=size[2], axis=2))[:, :, : shape[2]]


def times_gaussian(x: np.ndarray, wavenumbers: Sequence[np.ndarray], width: float) -> None:
    """Multiplies, in place, by the Fourier transform of a Gaussian, given the wavenumbers along each axis."""
    a, b, c = (np.exp(np.float32(-0.5 * width**2) * w**2) for w in wavenumbers)
    x *= a
    x *= b * c


def splat(points: Points, values: Float[np.ndarray, "p c"], lattice: Lattice) -> list[Grid]:
    """Densities of `values` at points, shared by the eight corners of their cells; none of points outside."""
    place = (points - lattice.low) / lattice.step
    at = np.floor(place).astype(int)[:, None] + CELL_CORNERS
    weight = np.prod(1 - np.abs(at - place[:, None]), axis=2) / lattice.step**3
    held = ((at >= 0) & (at < lattice.shape)).all(axis=2)
    flat = np.ravel_multi_index(tuple(at[held].T), lattice.shape)
    share = [(weight * v[:, None])[held] for v in values.T]
    count = int(np.prod(lattice.shape))
    return [
        np.bincount(flat, s, minlength=count).astype(float, copy=False).reshape(lattice.shape) for s in share
    ]


def surface_areas(
    points: Points,
    normals: Points,
    distance: Float[np.ndarray, "p k"],
    neighbors: Int[np.ndarray, "p k"],
) -> Float[np.ndarray, " p"]:
    """The share of the surface each point stands for: of the disc that holds its neighbors on the same face.

    `neighbors` names every point's, itself among them, nearest first, `distance` how far they are.
    """
    offset = points[neighbors] - points[:, None]
    along = np.einsum("pki,pi->pk", offset, normals) ** 2
    same = (np.einsum("pki,pi->pk", normals[neighbors], normals) > SAME_FACE_COSINE) & (
        along <= SAME_FACE_FLATNESS * distance**2
    )
    return np.pi * distance[:, -1] ** 2 / np.maximum(same.sum(axis=1), 2)
