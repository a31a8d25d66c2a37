"""Where a cloud is thinnest: normalized cuts of its neighborhood graph."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import eigh
from scipy.spatial import KDTree

from more2_jax.geometry.poses import Points

Rows = Bool[np.ndarray, " n"]
Cut = tuple[Rows, bool]  # one side, and whether the sides hardly touch

NEIGHBOR = 6  # the distance to this one is the width of the graph's weights
# Chosen on rooms of regime `real`, docs/developing/notebook/mask_repair.md.
GRAPH_POINTS = 400  # of a mask, that its graph has
NARROW = 0.003  # normalized cut: of 100 masks that hold two objects 76 have one as thin, of others 7


def thinnest_cuts(points: Points, count: int, least_share: float) -> list[Cut]:
    """Normalized cuts of a cloud's neighborhood graph (Shi and Malik 2000), one an eigenvector, least value first.

    Either side has `least_share` of the points. None where there are too few points.
    """
    few = points[np.linspace(0, len(points) - 1, min(len(points), GRAPH_POINTS)).astype(int)]
    few = np.unique(few, axis=0)
    if len(few) <= NEIGHBOR + count:
        return []
    squared = ((few[:, None] - few) ** 2).sum(axis=-1)
    width = np.sqrt(np.median(np.sort(squared, axis=1)[:, NEIGHBOR]))
    weights = np.exp(-squared / (2 * max(width, 1e-9) ** 2))
    root = 1 / np.sqrt(weights.sum(axis=1))
    laplacian = np.eye(len(few)) - root[:, None] * weights * root
    _, vectors = eigh(laplacian, subset_by_index=[1, count])
    _, nearest = KDTree(few).query(points)
    cuts = [best_threshold(root * v, weights, least_share) for v in vectors.T]
    return [(side[nearest], least < NARROW) for side, least in cuts]


def best_threshold(
    values: Float[np.ndarray, " n"], weights: Float[np.ndarray, "n n"], least_share: float
) -> tuple[Rows, float]:
    """The side of the cut along an eigenvector that has the least normalized cut, and that."""
    order = np.argsort(values)
    ordered = weights[np.ix_(order, order)]
    volume = np.cumsum(ordered.sum(axis=1))
    inside = np.cumsum(2 * np.tril(ordered, -1).sum(axis=1) + np.diag(ordered))
    cut = volume - inside
    score = cut[:-1] * (1 / volume[:-1] + 1 / np.maximum(volume[-1] - volume[:-1], 1e-12))
    size = np.arange(1, len(values))
    score[np.minimum(size, len(values) - size) < least_share * len(values)] = np.inf
    side = np.zeros(len(values), bool)
    best = int(np.argmin(score))
    side[order[: 1 + best]] = True
    return side, float(score[best])
