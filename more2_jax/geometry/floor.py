"""Height of the floor in a scan whose z is up: the lowest well-filled layer of its background."""

from __future__ import annotations

import numpy as np

from more2_jax.geometry.poses import Points

LAYER_M = 0.02  # thickness of the layers of the height histogram: a few times a depth camera's noise
# A stray point a kilometer off must not make a million layers: heights outside of these quantiles are left out.
HEIGHT_QUANTILES = (0.002, 0.998)
MIN_SHARE = 0.3  # of the fullest layer's points (a floor's, a table's, a ceiling's): the floor holds as many


def floor_height(background: Points) -> float | None:
    """Height of the lowest layer that holds a good part of the fullest one's points, meters; None without points."""
    if not len(background):
        return None
    least, most = np.quantile(background[:, 2], HEIGHT_QUANTILES)
    z = background[(background[:, 2] >= least) & (background[:, 2] <= most), 2]
    count, edges = np.histogram(z, bins=max(1, int(np.ceil(np.ptp(z) / LAYER_M))))
    lowest = int(np.argmax(count >= MIN_SHARE * count.max()))
    inside = (z >= edges[lowest] - LAYER_M) & (z <= edges[lowest + 1] + LAYER_M)
    return float(np.median(z[inside]))
