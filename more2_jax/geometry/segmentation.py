"""Instances without a network: large planes at the boundary of the scene removed, the rest clustered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Integer
from scipy.spatial import KDTree

from more2_jax.geometry.boundary_planes import Plane, boundary_planes, extent, floor_of, words
from more2_jax.geometry.segmentation_config import SegmentationConfig
from more2_jax.geometry.things_on_tops import above_floor, stands_within, things_on_tops
from more2_jax.geometry.touching_clusters import clusters_off_planes, touching
from more2_jax.geometry.voxels import voxel_means, voxel_normals
from more2_jax.types import Skipped


@dataclass(frozen=True, kw_only=True)
class Segmentation:
    """Clusters as instances, and what was looked at."""

    instance: Integer[np.ndarray, "n"]  # from 1, largest first; 0 is background
    planes: tuple[Plane, ...]
    skipped: tuple[Skipped, ...]

    def sentences(self) -> tuple[str, ...]:
        """What was removed and kept, in words."""
        removed = [words(p) for p in self.planes if p.structure]
        kept = [words(p) for p in self.planes if not p.structure]
        said = [f"removed as floor or wall: {'; '.join(removed) or 'no plane'}"]
        if kept:
            said.append(f"large planes kept as parts of objects: {'; '.join(kept)}")
        return tuple(said)


def segment_geometric(points: Float[np.ndarray, "n 3"], config: SegmentationConfig) -> Segmentation:
    """Cuts a cloud (meters, any frame) into floor, walls and clusters; the seed decides alone.

    A plane is floor, wall or ceiling if it is large, spans much of the scene, has nearly nothing beyond it, and
    is not just over or before another: no direction is taken for up, and a table top over a floor stays. How far
    apart two voxels of one part may be grows where points are sparse, as far from a camera. Where a floor is seen and
    z is up, what stands on the top of another part is an instance of its own.
    Raises ValueError for a cloud too wide for the voxel grid.
    """
    if not len(points):
        return Segmentation(instance=np.zeros(0, np.int64), planes=(), skipped=())
    voxels, voxel_of = voxel_means(points, config.voxel_m)
    normals = voxel_normals(voxels, config.normal_neighbors)
    planes, structure = boundary_planes(voxels, normals, config)
    cluster, apart = np.full(len(voxels), -1), np.zeros(len(voxels), bool)
    free, counts = ~structure, np.bincount(voxel_of)
    cluster[free], apart[free] = clustered(voxels[free], normals[free], counts[free], planes, config)
    cluster = without_flat(voxels, small_joined(voxels, cluster, apart, config), planes, config)
    instance, skipped = numbered(voxels, cluster, voxel_of, config)
    return Segmentation(instance=instance, planes=planes, skipped=skipped)


def clustered(
    voxels: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    counts: Integer[np.ndarray, "v"],
    planes: Sequence[Plane],
    config: SegmentationConfig,
) -> tuple[Integer[np.ndarray, "v"], Bool[np.ndarray, "v"]]:
    """Clusters of what touches, from 0, -1 for noise; and what stands on the top of another, each a cluster."""
    if len(voxels) <= config.core_neighbors:
        return np.full(len(voxels), -1), np.zeros(len(voxels), bool)
    near_m, core = touching(voxels, counts, config)
    cluster = clusters_off_planes(voxels, normals, near_m, core, planes, config)
    thing = things_on_tops(voxels, normals, cluster, near_m, planes, config)
    apart = thing >= 0
    return np.where(apart, thing + cluster.max(initial=-1) + 1, cluster), apart


def small_joined(
    voxels: Float[np.ndarray, "v 3"],
    cluster: Integer[np.ndarray, "v"],
    apart: Bool[np.ndarray, "v"],
    config: SegmentationConfig,
) -> Integer[np.ndarray, "v"]:
    """Pieces given to the nearest other cluster, the smallest first: a leg to its table. None of what is `apart`."""
    cluster = cluster.copy()
    ids, counts = np.unique(cluster[(cluster >= 0) & ~apart], return_counts=True)
    small = counts * config.voxel_m**2 < config.join_area_m2
    for piece in ids[small][np.argsort(counts[small], kind="stable")]:
        rows, others = cluster == piece, (cluster >= 0) & (cluster != piece)
        if not others.any():
            continue
        gap, nearest = map(
            np.asarray, KDTree(voxels[others]).query(voxels[rows], distance_upper_bound=config.join_m)
        )
        if np.isfinite(gap).any():
            cluster[rows] = cluster[others][nearest[np.argmin(gap)]]
    return cluster


def without_flat(
    voxels: Float[np.ndarray, "v 3"],
    cluster: Integer[np.ndarray, "v"],
    planes: tuple[Plane, ...],
    config: SegmentationConfig,
) -> Integer[np.ndarray, "v"]:
    """Without patches of floors and walls: sensors warp a wall at the border of their view.

    Nor strips along several of them, as drift leaves in corners. What rises from a floor that lies around it is a
    thing: a pillow.
    """
    cluster, structure = cluster.copy(), [p for p in planes if p.structure]
    count = cluster.max(initial=-1) + 1
    total = np.bincount(cluster[cluster >= 0], minlength=count)
    near = np.zeros((len(structure), len(voxels)), bool)
    for of_plane, plane in zip(near, structure, strict=True):
        of_plane[:] = np.abs(voxels @ plane.normal - plane.offset_m) < config.flat_m

    def mostly(rows: Bool[np.ndarray, "v"]) -> Bool[np.ndarray, " k"]:
        return np.bincount(cluster[rows & (cluster >= 0)], minlength=count) > config.flat_share * total

    flat, floor = np.zeros(count, bool), floor_of(planes)
    for of_plane, plane in zip(near, structure, strict=True):
        of_one = mostly(of_plane)
        if plane is floor:
            of_one[[k for k in np.flatnonzero(of_one) if _rises(voxels, cluster, int(k), plane, config)]] = (
                False
            )
        flat |= of_one
    for k in np.flatnonzero(mostly(np.logical_or.reduce(near, axis=0)) & ~flat):
        flat[k] = extent(voxels[cluster == k]) > config.strip_m
    cluster[np.append(flat, False)[cluster]] = -1  # the last is that of -1
    return cluster


def _rises(
    voxels: Float[np.ndarray, "v 3"],
    cluster: Integer[np.ndarray, "v"],
    k: int,
    floor: Plane,
    config: SegmentationConfig,
) -> bool:
    """Whether a cluster stands out from the floor around it."""
    flat, height = above_floor(voxels, floor)
    own = cluster == k
    bare = flat[(cluster < 0) & (np.abs(height) < config.plane_distance_m)]
    high = float(np.percentile(height[own], 95)) > config.lowest_m
    return high and stands_within(flat[own], bare, config)


def numbered(
    voxels: Float[np.ndarray, "v 3"],
    cluster: Integer[np.ndarray, "v"],
    voxel_of: Integer[np.ndarray, "n"],
    config: SegmentationConfig,
) -> tuple[Integer[np.ndarray, "n"], tuple[Skipped, ...]]:
    """Instance of every point: clusters large enough to be objects, from 1 by their points; the rest told."""
    ids = np.unique(cluster[cluster >= 0])
    points = np.bincount(cluster[voxel_of] + 1, minlength=ids.max(initial=0) + 2)[1:]
    large = [i for i in ids if _is_large(voxels[cluster == i], config)]
    number = np.zeros(len(points) + 1, np.int64)  # the last is that of -1: background
    for k, i in enumerate(sorted(large, key=lambda i: -points[i]), 1):
        number[i] = k
    if not (small := len(ids) - len(large)):
        return number[cluster][voxel_of], ()
    reason = f"less than {config.smallest_area_m2:g} m² or shorter than {config.smallest_extent_m:g} m"
    return number[cluster][voxel_of], (Skipped(what=f"{small} small clusters", reason=reason),)


def _is_large(voxels: Float[np.ndarray, "v 3"], config: SegmentationConfig) -> bool:
    area = len(voxels) * config.voxel_m**2
    return area >= config.smallest_area_m2 and extent(voxels) >= config.smallest_extent_m
