"""What one scan of a room shows to be empty: space before its surfaces, held against the surfaces of another scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int8, Integer
from scipy.spatial import KDTree

from more2_jax.geometry.poses import Points, Pose, apply_pose
from more2_jax.geometry.voxels import voxel_means, voxel_normals

# Chosen on rooms of regime `real` (fused at 2 to 3 cm, walls 1 to 3 cm thick): `eval.segmentation`, seed 404.
NEIGHBORS = 20  # of a voxel's normal
NEAR_M = 0.07  # off the other scan's surface: drift and noise of both; less has not changed
SPACING_M = 0.06  # along that surface: between its points
MOST_SPACING_M = 0.25  # farther off, no surface is continued
CONTINUED_BY = 8  # nearest points, by the tangent planes of which it is
EMPTY_FROM_M, EMPTY_TO_M, EMPTY_STEP_M = 0.1, 1.5, 0.05  # before a surface, where nothing else stands
BLOCKED_M = 0.06  # a surface this near to the line ends what is empty
KEPT_M = 0.03  # one of such points in a cube of this side is enough
REACH_M = 0.06  # of a point that is known to be empty

STAYED, EMPTIED, UNKNOWN = 0, 1, 2  # states of a voxel


@dataclass(frozen=True, kw_only=True)
class UnlabeledScan:
    """One scan without instances, meters, in a frame of its own."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"] | None = None  # out of the matter, 0 where not known; None: none is
    sensors: Float[np.ndarray, "s 3"] | None = None  # where they stood; None: not known


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A scan in voxels: their mean points, and normals towards where it was seen from."""

    points: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"]
    counts: Integer[np.ndarray, " v"]
    voxel_of: Integer[np.ndarray, " n"]
    tree: KDTree


def surface_of(scan: UnlabeledScan, voxel_m: float) -> Surface:
    """The voxels of a scan that is not empty. Raises ValueError for one too wide for their grid."""
    points, voxel_of = voxel_means(scan.points, voxel_m)
    normals = voxel_normals(points, NEIGHBORS)
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    seen_from = scan.sensors.mean(axis=0) if scan.sensors is not None and len(scan.sensors) else middle
    side = np.einsum("vi,vi->v", normals, seen_from - points)
    if scan.normals is not None:
        sums = np.stack([np.bincount(voxel_of, scan.normals[:, k]) for k in range(3)], axis=-1)
        given = np.einsum("vi,vi->v", normals, sums)
        side = np.where(given != 0, given, side)
    return Surface(
        points=points,
        normals=np.where(side < 0, -1.0, 1.0)[:, None] * normals,
        counts=np.bincount(voxel_of),
        voxel_of=voxel_of,
        tree=KDTree(points),
    )


def empty_before(surface: Surface) -> Points:
    """Points of the space before a scan's surfaces, up to the next of them: what saw the surface saw through it.

    Taken along normals, which need no sensor: a floor is seen from above, a wall from the room. Space that no surface
    bounds, or that only a part hidden from the sensor bounds, is not among them.
    """
    found, open_ = [np.zeros((0, 3))], np.arange(len(surface.points))
    for away_m in np.arange(EMPTY_FROM_M, EMPTY_TO_M, EMPTY_STEP_M):
        at = surface.points[open_] + away_m * surface.normals[open_]
        clear = np.isinf(surface.tree.query(at, distance_upper_bound=BLOCKED_M)[0])
        open_ = open_[clear]
        found.append(at[clear])
    points = np.concatenate(found)
    return voxel_means(points, KEPT_M)[0] if len(points) else points


def states(surface: Surface, other: Surface, T_other_scan: Pose, empty: Points) -> Int8[np.ndarray, " v"]:
    """What another scan says of each voxel of a scan: `STAYED`, `EMPTIED` or `UNKNOWN`, where it did not look.

    `empty` is `empty_before` of the other.
    """
    points = apply_pose(T_other_scan, surface.points)
    state = np.where(_off_surface(points, other) < NEAR_M, STAYED, UNKNOWN).astype(np.int8)
    if len(empty):
        asked = np.flatnonzero(state == UNKNOWN)
        gap, _ = KDTree(empty).query(points[asked], distance_upper_bound=REACH_M)
        state[asked[np.isfinite(gap)]] = EMPTIED
    return state


def _off_surface(points: Points, other: Surface) -> Float[np.ndarray, " n"]:
    """Distance to a surface that goes on along its tangent planes by `SPACING_M`, meters; inf where it is far."""
    k = min(CONTINUED_BY, len(other.points))
    distance, near = (
        np.asarray(x).reshape(len(points), k)
        for x in other.tree.query(points, k=k, distance_upper_bound=MOST_SPACING_M)
    )
    near = np.minimum(near, len(other.points) - 1)
    across = np.einsum("nki,nki->nk", points[:, None] - other.points[near], other.normals[near])
    across = np.where(np.isfinite(distance), across, np.inf)
    along = np.sqrt(np.maximum(distance**2 - np.where(np.isfinite(across), across, 0.0) ** 2, 0.0))
    return np.hypot(across, np.maximum(along - SPACING_M, 0.0)).min(axis=1)
