"""Near-duplicates across splits, found by signed distances on a coarse grid.

Two shapes are near-duplicates if, at the best of four quarter turns about the vertical, their distances differ
by less than a threshold on average over the grid of the canonical box. Mirror images count as different.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.distance import cdist

THRESHOLD = 0.004  # canonical units: 4 mm of a piece 0.9 m long
CHUNK = 256


@dataclass(frozen=True, kw_only=True)
class Twin:
    """A shape that is left out, because another split has nearly the same one."""

    name: str
    split: str
    of: str
    of_split: str
    distance: float  # mean difference of signed distances, canonical units


def nearest_twins(
    shapes: Float[np.ndarray, "a 8 8 8"], others: Float[np.ndarray, "b 8 8 8"]
) -> tuple[Int[np.ndarray, " a"], Float[np.ndarray, " a"]]:
    """For every shape the most similar of `others` (at least one), and the difference between the two."""
    flat = others.reshape(len(others), -1).astype(np.float32)
    index, difference = np.zeros(len(shapes), int), np.full(len(shapes), np.inf)
    for start in range(0, len(shapes), CHUNK):
        rows = slice(start, start + CHUNK)
        for turn in range(4):
            turned = np.rot90(shapes[rows], turn, axes=(1, 2)).reshape(-1, flat.shape[1])
            matrix = cdist(turned.astype(np.float32), flat, "cityblock") / flat.shape[1]
            best = matrix.argmin(axis=1)
            value = matrix[np.arange(len(best)), best]
            closer = value < difference[rows]
            index[rows] = np.where(closer, best, index[rows])
            difference[rows] = np.where(closer, value, difference[rows])
    return index, difference


def twins_across_splits(
    names: Sequence[str],
    splits: Sequence[str],
    fingerprints: Float[np.ndarray, "n 8 8 8"],
    threshold: float = THRESHOLD,
) -> list[Twin]:
    """The shapes to leave out so that no split shares a near-duplicate with another.

    The test split stays whole: what resembles it leaves training and validation. A validation shape that
    resembles a training shape leaves validation.
    """
    split_of = np.asarray(splits)
    found: dict[str, Twin] = {}
    for leaving, staying in (("train", "test"), ("val", "test"), ("val", "train")):
        gone = np.array([n in found for n in names], bool)
        a, b = np.flatnonzero((split_of == leaving) & ~gone), np.flatnonzero((split_of == staying) & ~gone)
        if not len(a) or not len(b):
            continue
        index, difference = nearest_twins(fingerprints[a], fingerprints[b])
        for k in np.flatnonzero(difference < threshold).tolist():
            name = names[int(a[k])]
            found[name] = Twin(
                name=name,
                split=leaving,
                of=names[int(b[index[k]])],
                of_split=staying,
                distance=float(difference[k]),
            )
    return list(found.values())
