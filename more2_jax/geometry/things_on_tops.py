"""What stands on the level top of something else, and touches it only from above: a lamp on its table.

A level of a cluster, with a part above it that stands within its outline and has the level around it. The back of a
chair stands at the edge of its seat, and stays with it. Heights are those above the floor, so that one must be seen.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float, Integer
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, KDTree, QhullError

from more2_jax.geometry.boundary_planes import Plane, floor_of
from more2_jax.geometry.segmentation_config import SegmentationConfig

LEVEL = 0.9  # cosine between up and the normal of a voxel on a top
BIN_M = 0.02  # of the heights that are counted
MOST = 0.5  # share of a cluster that a thing on it has at most
DIRECTIONS = 12

Flat = Float[np.ndarray, "_ 2"]  # places on the floor


def things_on_tops(
    voxels: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    cluster: Integer[np.ndarray, " v"],
    near_m: csr_matrix,
    planes: Sequence[Plane],
    config: SegmentationConfig,
) -> Integer[np.ndarray, " v"]:
    """The things that stand on a top, from 0; −1 for all else, and for all where no floor tells where up is.

    `near_m`: how far voxels lie that touch (`touching_clusters.touching`).
    """
    thing = np.full(len(voxels), -1)
    if (floor := floor_of(planes)) is None:
        return thing
    flat, height = above_floor(voxels, floor)
    level = np.abs(normals @ floor.normal) > LEVEL
    for k in range(cluster.max(initial=-1) + 1):
        rows = np.flatnonzero(cluster == k)
        if len(rows) * config.voxel_m**2 < config.top_area_m2 + config.smallest_area_m2:
            continue
        own = _in_cluster(flat[rows], height[rows], level[rows], near_m[rows][:, rows], config)
        thing[rows] = np.where(own < 0, -1, own + thing.max(initial=-1) + 1)
    return thing


def above_floor(
    voxels: Float[np.ndarray, "v 3"], floor: Plane
) -> tuple[Float[np.ndarray, "v 2"], Float[np.ndarray, " v"]]:
    """Where voxels lie along the floor, and how high above it."""
    x = np.cross([0.0, 1.0, 0.0], floor.normal)
    x /= np.linalg.norm(x)
    return voxels @ np.stack([x, np.cross(floor.normal, x)], axis=1), voxels @ floor.normal - floor.offset_m


def _in_cluster(
    flat: Float[np.ndarray, "m 2"],
    height: Float[np.ndarray, " m"],
    level: Bool[np.ndarray, " m"],
    near_m: csr_matrix,
    config: SegmentationConfig,
) -> Integer[np.ndarray, " m"]:
    """Things on the tops of one cluster, the highest top first."""
    thing = np.full(len(flat), -1)
    least = config.smallest_area_m2 / config.voxel_m**2
    for top_m in tops(height[level], config):
        rest = thing < 0
        on = rest & level & (np.abs(height - top_m) < config.top_m)
        above = np.flatnonzero(rest & (height > top_m + config.top_m))
        part = connected_components(near_m[above][:, above], directed=False)[1]
        for k in np.flatnonzero(np.bincount(part, minlength=1) >= least):
            rows = above[part == k]
            foot = flat[rows[height[rows] < top_m + config.foot_m]]
            if len(rows) < MOST * rest.sum() and stands_within(
                foot, patch_at(flat[on], foot, config), config
            ):
                thing[rows] = thing.max() + 1
    return thing


def tops(height: Float[np.ndarray, " m"], config: SegmentationConfig) -> Iterator[float]:
    """Heights of the levels that are wide enough for something to stand on, the highest first."""
    if not len(height):
        return
    low, least = height.min(), config.top_area_m2 / config.voxel_m**2
    count = np.convolve(np.bincount(((height - low) / BIN_M).astype(int)), np.ones(3), "same")
    found = []
    while count.max() >= least:
        k = int(count.argmax())
        about = np.abs(height - low - BIN_M * (k + 0.5)) < config.top_m
        found.append(float(np.median(height[about])))
        count[max(0, k - 3) : k + 4] = 0
    yield from sorted(found, reverse=True)


def patch_at(level: Flat, foot: Flat, config: SegmentationConfig) -> Flat:
    """What hangs together of a level, nearest to where something stands on it."""
    if len(level) < 2 or not len(foot):
        return level[:0]
    k = min(9, len(level))
    distance, near = map(np.asarray, KDTree(level).query(level, k=k, distance_upper_bound=config.around_m))
    a, slot = np.nonzero(np.isfinite(distance))
    graph = csr_matrix((np.ones(len(a)), (a, near[a, slot])), shape=(len(level),) * 2)
    patch = connected_components(graph, directed=False)[1]
    nearest = int(np.linalg.norm(level - foot.mean(axis=0), axis=1).argmin())
    return level[patch == patch[nearest]]


def stands_within(foot: Flat, patch: Flat, config: SegmentationConfig) -> bool:
    """Whether a foot lies within the outline of a level, is smaller, and has it around in several directions.

    Posts of a shelf stand within the outline of its lowest board, too, but all over it.
    """
    try:
        outline, own = ConvexHull(patch), ConvexHull(foot)
    except (QhullError, ValueError):  # too few, or on a line
        return False
    if len(patch) * config.voxel_m**2 < config.top_area_m2 or own.volume > config.foot_share * outline.volume:
        return False
    edges = outline.equations
    inside = (foot @ edges[:, :2].T + edges[:, 2] <= -config.voxel_m).all(axis=1)
    if float(inside.mean()) < config.inside_share:
        return False
    middle = foot.mean(axis=0)
    reach_m = np.linalg.norm(foot - middle, axis=1).max() + config.around_m
    around = (patch - middle)[np.linalg.norm(patch - middle, axis=1) < reach_m]
    turn = np.arctan2(around[:, 1], around[:, 0]) / (2 * np.pi) + 0.5
    return len(np.unique((turn * DIRECTIONS).astype(int) % DIRECTIONS)) >= config.around
