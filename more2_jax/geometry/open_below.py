"""How much a scan shows beneath an object: what stands on legs hides little of the floor, what is solid hides it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, KDTree, QhullError

from more2_jax.geometry.poses import Points, Pose, apply_pose

# Chosen on rooms of validation furniture, docs/developing/notebook/open_below.md.
CELL_M = 0.05  # a side of the columns that the footprint is divided into,
MOST_COLUMNS = 200  # along a side of it
BESIDE_M = 0.035  # so near a column's middle something was seen beneath,
BESIDE_SPACINGS = 2.0  # or within so many distances between neighbors, of a background that was thinned,
MOST_BESIDE_M = 0.08  # but not farther
AROUND_M = 0.3  # of the footprint: how far apart the background's points lie
LOWEST_SHARE = 0.005  # of the points lie lower than where the object begins: strays
UNDER_M = (-0.15, 0.1)  # from there: the floor that it stands on, not one far below what hangs on a wall
SOLID, OPEN = 0.7, 0.95  # shares of the footprint: up to the first it may be solid, from the second it is not


def openness(seen_beneath: float) -> float:
    """0 for what may be solid, 1 for what stands on legs or a thin foot, by the share of its footprint seen beneath."""
    return float(np.clip((seen_beneath - SOLID) / (OPEN - SOLID), 0.0, 1.0))


def most_seen_beneath(points: Points, poses: Sequence[Pose], backgrounds: Sequence[Points]) -> float:
    """`share_seen_beneath` an object by that scan which shows most; 0 without scans.

    `poses` map the scans' frames, of `backgrounds`, onto the object's, in which z is up.
    """
    shares = (share_seen_beneath(points, apply_pose(T, b)) for T, b in zip(poses, backgrounds, strict=True))
    return max(shares, default=0.0)


def share_seen_beneath(points: Points, background: Points) -> float:
    """Share of the columns in an object's footprint (the convex hull, seen from above) with a background point beneath.

    Meters, one frame, z up. 0 where the scan shows nothing, and for points that lie on a line, seen from above.
    """
    columns = footprint(points[:, :2])
    if not len(columns):
        return 0.0
    bottom = np.quantile(points[:, 2], LOWEST_SHARE)
    low = [*(columns.min(axis=0) - AROUND_M), bottom + UNDER_M[0]]
    high = [*(columns.max(axis=0) + AROUND_M), bottom + UNDER_M[1]]
    beneath = background[((background > low) & (background < high)).all(axis=1), :2]
    if len(beneath) < 2:
        return 0.0
    tree = KDTree(beneath)
    apart = np.median(tree.query(beneath, k=2)[0][:, 1])
    beside = np.clip(BESIDE_SPACINGS * apart, BESIDE_M, MOST_BESIDE_M)
    return float(np.isfinite(tree.query(columns, distance_upper_bound=beside)[0]).mean())


def footprint(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "c 2"]:
    """Middles of the columns inside the convex hull; none if the points lie on a line."""
    nothing = np.zeros((0, 2))
    if len(points) < 3:
        return nothing
    try:
        hull = ConvexHull(points)
    except QhullError:  # on a line
        return nothing
    low, high = points.min(axis=0), points.max(axis=0)
    cell = max(CELL_M, (high - low).max() / MOST_COLUMNS)
    x, y = (np.arange(a + cell / 2, b, cell) for a, b in zip(low, high, strict=True))
    middles = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    return middles[(middles @ hull.equations[:, :2].T + hull.equations[:, 2] <= 0).all(axis=1)]
