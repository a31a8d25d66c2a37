"""Instances of very many points, thinned evenly in space: searches for neighbors take time for every one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Integer

from more2_jax.types import Instance

# Of an instance: 2 cm apart on a sofa, and scans are fused at 2 to 4 cm.
MOST_POINTS = 10_000
FINEST = 1 / 4096  # first side of a cell, as a share of the instance's size
FARTHEST = 2**53  # cells: where stray points lie, whole numbers still being exact
STEP = 1.1  # a cell's side grows by this factor at least, until few enough cells are occupied
# One number of a cell. Where two cells share one, one is dropped.
MIXED = np.array([73_856_093, 19_349_663, 83_492_791], np.int64)


def thinned_instances(instances: Sequence[Instance]) -> tuple[tuple[Instance, ...], tuple[str, ...]]:
    """The instances with at most `MOST_POINTS` points each, and a warning where some had more."""
    large = [len(i.points) for i in instances if len(i.points) > MOST_POINTS]
    if not large:
        return tuple(instances), ()
    has = "1 instance has" if len(large) == 1 else f"{len(large)} instances have"
    said = (
        f"{has} more than {MOST_POINTS} points, up to {max(large)}; each is thinned to {MOST_POINTS} or fewer,"
        " evenly in space"
    )
    return tuple(_thinned(i) for i in instances), (said,)


def _thinned(instance: Instance) -> Instance:
    if len(instance.points) <= MOST_POINTS:
        return instance
    rows = spread(instance.points, MOST_POINTS)
    colors = None if instance.colors is None else instance.colors[rows]
    normals = None if instance.normals is None else instance.normals[rows]
    return replace(instance, points=instance.points[rows], colors=colors, normals=normals)


def spread(points: Float[np.ndarray, "n 3"], most: int) -> Integer[np.ndarray, " k"]:
    """Rows of at most `most` points spread evenly over the cloud: the first one of every occupied cell, ascending.

    Points stay what they are, noise included. Nearly all of `most` remain where the cloud is a surface. Where all
    but a tenth of the cloud lies in one place, rows are taken evenly by index.
    """
    low, high = np.percentile(points, (5, 95), axis=0)  # a stray point does not coarsen the cells
    side = float((high - low).max()) * FINEST
    rows = np.arange(len(points)) if side else np.arange(0, len(points), -(-len(points) // most))
    while len(rows) > most:
        cells = np.clip(np.floor((points - low) / side), -FARTHEST, FARTHEST).astype(np.int64)
        rows = np.sort(np.unique(cells @ MIXED, return_index=True)[1])
        side *= max(STEP, (len(rows) / most) ** 0.5)
    return rows
