"""The floor of a room, from the points that belong to no object."""

from __future__ import annotations

import numpy as np

from more2_jax.geometry.poses import Points

LAYER_M = 0.02  # thickness of the layers among which a floor is sought
STRAY = (0.002, 0.998)  # quantiles of height outside of which points are none of a room's
FLOOR_SHARE = 0.3  # of the fullest layer: the lowest that holds as much is the floor


def floor_height(background: Points) -> float | None:
    """Height of the lowest layer that holds a good part of the fullest one's points, meters; None without points."""
    if not len(background):
        return None
    # A stray point a kilometer off must not make a million layers.
    least, most = np.quantile(background[:, 2], STRAY)
    z = background[(background[:, 2] >= least) & (background[:, 2] <= most), 2]
    count, edges = np.histogram(z, bins=max(1, int(np.ceil(np.ptp(z) / LAYER_M))))
    lowest = int(np.argmax(count >= FLOOR_SHARE * count.max()))
    inside = (z >= edges[lowest] - LAYER_M) & (z <= edges[lowest + 1] + LAYER_M)
    return float(np.median(z[inside]))
