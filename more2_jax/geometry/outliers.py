"""Local outlier factors: points apart from their neighborhood are flying pixels and depth noise, not a surface.

After Breunig et al. (2000), in the simplest form: how far a point's neighbors are, against how far those of its
neighbors are. Sparse sampling alone makes no outlier, since it is sparse around it as well.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

NEIGHBORS = 12  # those of the planes of a mesh: what is no surface there is left out here

Points = Float[np.ndarray, "n 3"]


def outlier_factors(points: Points) -> Float[np.ndarray, " n"]:
    """Mean distance of every point's neighbors over the mean of theirs; near 1 within a surface, 1 of doubled points.

    All 1 where there are too few points to tell.
    """
    if len(points) <= NEIGHBORS:
        return np.ones(len(points))
    distance, near = KDTree(points).query(points, k=NEIGHBORS + 1)
    own = np.asarray(distance)[:, 1:].mean(axis=1)
    around = own[np.asarray(near)[:, 1:]].mean(axis=1)
    return np.divide(own, around, out=np.ones(len(points)), where=around > 0)


def inliers(points: Points, max_factor: float) -> Bool[np.ndarray, " n"]:
    """True for points whose factor is `max_factor` or less; for all where that is 0."""
    return outlier_factors(points) <= max_factor if max_factor else np.ones(len(points), bool)
