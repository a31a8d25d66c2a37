"""Fields sampled on a regular lattice: where its corners lie, finer lattices, cells near the surface."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Real
from scipy.ndimage import binary_dilation, maximum_filter

Grid = Float[np.ndarray, "i j k"]
Mask = Bool[np.ndarray, "i j k"]
Points = Float[np.ndarray, "p 3"]

ROUNDING = 1e-6  # of a step, by which a corner may seem to lie farther off


@dataclass(frozen=True)
class Lattice:
    """Corners of cubic cells; canonical units, relative to the object's center."""

    low: Float[np.ndarray, "3"]  # the first corner
    step: float  # edge of a cell
    shape: tuple[int, ...]  # corners along each axis

    def at(self, index: Real[np.ndarray, "*p 3"]) -> Float[np.ndarray, "*p 3"]:
        """Where corners lie, and what lies between them by fractions."""
        return self.low + self.step * index

    def corners(self) -> Points:
        """All of them, the last axis fastest."""
        return self.at(np.indices(self.shape).reshape(3, -1).T)

    def finer(self) -> Lattice:
        """The lattice with half the step, over the same box."""
        return Lattice(self.low, self.step / 2, tuple(2 * n - 1 for n in self.shape))

    def corners_near(self, points: Points, distance: float) -> Mask:
        """Corners within `distance` of a point, and some a little farther off."""
        # A point is half a step off the corner nearest to it, at most, along each axis.
        reach = int(distance / self.step + 0.5 + ROUNDING)
        corner = np.rint((points - self.low) / self.step).astype(int) + reach
        size = np.add(self.shape, 2 * reach)  # points beside the lattice are near its corners, too
        held = corner[((corner >= 0) & (corner < size)).all(axis=1)]
        holds = np.zeros(size, bool)
        holds[tuple(held.T)] = True
        inside = tuple(slice(reach, reach + n) for n in self.shape)
        return maximum_filter(holds, size=2 * reach + 1)[inside]


@dataclass(frozen=True)
class GridField:
    """A field on a lattice, and the values whose zero level is the surface."""

    lattice: Lattice
    field: Grid  # the network's, or interpolated
    values: Grid  # corrected by what was observed

    def finer(self) -> GridField:
        """Both interpolated to half the step."""
        return GridField(self.lattice.finer(), upsampled(self.field), upsampled(self.values))

    def around(self, kept: Mask, margin: float) -> GridField:
        """The box that holds all corners of `kept`, and `margin` (canonical units) around it; all, if it is empty."""
        held = np.argwhere(kept)
        if not len(held):
            return self
        cells = int(np.ceil(margin / self.lattice.step)) + 1
        first = np.maximum(held.min(axis=0) - cells, 0)
        last = np.minimum(held.max(axis=0) + cells + 1, self.field.shape)
        box = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
        field, values = self.field[box], self.values[box]
        return GridField(replace(self.lattice, low=self.lattice.at(first), shape=field.shape), field, values)


def cube(cells: int, half: float) -> Lattice:
    """`cells` a side, from −`half` to `half`."""
    return Lattice(np.full(3, -half), 2 * half / cells, (cells + 1,) * 3)


def upsampled(x: Grid) -> Float[np.ndarray, "2*i-1 2*j-1 2*k-1"]:
    """Linear interpolation to half the step: `scipy.ndimage.zoom`, which takes eight times as long."""
    for axis in (2, 1, 0):
        shape = list(x.shape)
        shape[axis] = 2 * shape[axis] - 1
        finer = np.empty(shape, x.dtype)
        old, new = np.moveaxis(x, axis, 0), np.moveaxis(finer, axis, 0)  # views
        new[::2] = old
        new[1::2] = (old[:-1] + old[1:]) / 2
        x = finer
    return x


def surface_cells(values: Grid, step: float) -> Bool[np.ndarray, "i-1 j-1 k-1"]:
    """Cells whose corners differ in sign, or are nearer to the surface than the cell's diagonal: a thin leg may
    pass between corners. One ring of cells more, since the field is only nearly a distance."""
    i, j, k = (n - 1 for n in values.shape)
    offsets = itertools.product((0, 1), repeat=3)
    corners = np.stack([values[x : x + i, y : y + j, z : z + k] for x, y, z in offsets])
    straddles = (corners.min(axis=0) < 0) & (corners.max(axis=0) >= 0)
    close = np.abs(corners).min(axis=0) < 0.5 * np.sqrt(3) * step
    return binary_dilation(straddles) | close


def crossed_corners(values: Grid) -> Mask:
    """The corners of all cells whose corners differ in sign."""
    some = every = values < 0
    for axis in range(3):
        some, every = (_joined(x, axis, f) for x, f in ((some, np.logical_or), (every, np.logical_and)))
    crossed = np.pad(some & ~every, 1)
    for axis in range(3):
        crossed = _joined(crossed, axis, np.logical_or)
    return crossed


def _joined(x: Mask, axis: int, with_next: np.ufunc) -> Bool[np.ndarray, "_ _ _"]:
    """Every value with the next along an axis."""
    first, second = [slice(None)] * 3, [slice(None)] * 3
    first[axis], second[axis] = slice(None, -1), slice(1, None)
    return with_next(x[tuple(first)], x[tuple(second)])
