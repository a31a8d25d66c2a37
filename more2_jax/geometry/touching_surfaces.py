"""Whether two clouds of one scan are parts of one surface."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from more2_jax.geometry.poses import Points

# Chosen on rooms of regimes `paper`, `sparse` and `real`, docs/developing/notebook/mask_parts.md.
TOUCHING = 2.0  # distances between neighboring points: parts of one surface lie no farther apart
# Of as many points as a line across the smaller cloud has: so many of both lie that near the other.
LEAST_TOUCHING = 0.5


def touch(one: Points, other: Points) -> bool:
    """Whether two clouds are parts of one surface: along a line, as near one another as their points are."""
    one, other = np.unique(one, axis=0), np.unique(other, axis=0)  # points given twice lie no nearer
    if min(len(one), len(other)) < 2:
        return False  # without a distance between neighbors
    reach = TOUCHING * spacing_of_two(one, other)
    near = [KDTree(a).query(b, distance_upper_bound=reach)[0] for a, b in ((one, other), (other, one))]
    across = min(len(one), len(other)) ** 0.5
    return sum(int(np.isfinite(d).sum()) for d in near) >= LEAST_TOUCHING * across


def spacing_of_two(one: Points, other: Points) -> float:
    """Median distance between neighboring points of two clouds, meters."""
    distances = [KDTree(p).query(p, k=2)[0][:, 1] for p in (one, other)]
    return float(np.median(np.concatenate(distances)))
