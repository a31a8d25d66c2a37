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

import numpy as np
from jaxtyping import Float
from scipy.fft import irfftn, next_fast_len, rfftn
from scipy.spatial import KDTree

Grid = Float[np.ndarray, "n n n"]
Points = Float[np.ndarray, "p 3"]

SOFT = 1.5  # cells on either side of the surface in which an indicator goes from 1 to 0
MARGIN = 2.0  # screening lengths around the box, which the Fourier transform takes as periodic
AGREE = 0.5  # cosine from which on a neighbour's normal is of the same face,
CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))  # of a cell
FLAT = 0.1  # and share of its squared distance that it may lie off that face


def screened(
    field: Grid, half: float, points: Points, normals: Points, area: Float[np.ndarray, " p"], length: float
) -> Grid:
    """The field on a cube's grid from −`half` to `half`, its sides near `points` put right; canonical units.

    `normals` are unit and outward, `area` is the share of the surface each point stands for, `length` is ℓ. Near
    the surface the result is nearly a distance; `SOFT` cells away from it, it is cut off.
    """
    n = len(field)
    step = 2 * half / (n - 1)
    prior = np.clip(0.5 - field / (2 * SOFT * step), 0.0, 1.0)
    size = next_fast_len(n + int(np.ceil(MARGIN * length / step)), real=True) or n
    k = [2 * np.pi * f(size, step) for f in (np.fft.fftfreq, np.fft.fftfreq, np.fft.rfftfreq)]
    waves = np.meshgrid(*(x.astype(np.float32) for x in k), indexing="ij", sparse=True)
    squared = waves[0] ** 2 + waves[1] ** 2 + waves[2] ** 2
    # Both gradients as smooth as the grid can hold, or as the points are dense.
    width = max(step, np.sqrt(float(np.median(area))))
    flux = [splat(points, -area * normals[:, i], half, n) for i in range(3)]
    divergence = sum(np.complex64(1j) * w * transform(v, size) for w, v in zip(waves, flux, strict=True))
    change = -squared * smooth(squared, step) * transform(prior, size) - smooth(squared, width) * divergence
    change = np.asarray(irfftn(change / (squared + np.float32(length**-2)), s=[size] * 3, workers=-1))
    return (0.5 - prior - change[:n, :n, :n]) * 2 * SOFT * step


def transform(x: Grid, size: int) -> np.ndarray:
    """Fourier transform of a grid with empty space after it, single precision."""
    return np.asarray(rfftn(x.astype(np.float32), s=[size] * 3, workers=-1))


def smooth(squared: np.ndarray, width: float) -> np.ndarray:
    """What a Gaussian of this width leaves of waves, given the squares of their numbers."""
    return np.exp(np.float32(-0.5 * width**2) * squared)


def splat(points: Points, value: Float[np.ndarray, " p"], half: float, n: int) -> Grid:
    """Density on the grid of `value` at points, shared by the eight corners of their cells; none of points outside."""
    step = 2 * half / (n - 1)
    place = (points + half) / step
    at = np.floor(place).astype(int)[:, None] + CORNERS
    weight = np.prod(1 - np.abs(at - place[:, None]), axis=2) * value[:, None]
    held = ((at >= 0) & (at < n)).all(axis=2)
    flat = np.ravel_multi_index(tuple(at[held].T), (n, n, n))
    return np.bincount(flat, weight[held], minlength=n**3).reshape(n, n, n) / step**3


def areas(tree: KDTree, normals: Points, neighbours: int) -> Float[np.ndarray, " p"]:
    """The share of the surface each point stands for: of the disc that holds its neighbours on the same face."""
    points = np.asarray(tree.data)
    distance, near = tree.query(points, k=neighbours, workers=-1)
    offset = points[near] - points[:, None]
    along = np.einsum("pki,pi->pk", offset, normals) ** 2
    same = (np.einsum("pki,pi->pk", normals[near], normals) > AGREE) & (along <= FLAT * distance**2)
    return np.pi * distance[:, -1] ** 2 / np.maximum(same.sum(axis=1), 2)
