"""Instances without a network: large planes at the boundary of the scene removed, the rest clustered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from more2_jax.types import Skipped

LARGEST_GRID = 2**20  # voxels along an axis


@dataclass(frozen=True)
class SegmentationConfig:
    """Settings of `segment_geometric`; lengths in metres."""

    voxel_m: float = 0.03
    normal_neighbours: int = 20
    plane_distance_m: float = 0.05  # a voxel this near belongs to the plane
    plane_angle_deg: float = 30.0  # and if its normal turns less than this from the plane's
    plane_tries: int = 400
    planes: int = 12  # looked at, whether removed or not
    structure_area_m2: float = 0.6  # smaller planes are parts of objects
    behind_share: float = 0.04  # of the scene may lie beyond a floor or wall
    link_m: float = 0.06  # voxels this near touch
    core_neighbours: int = 7  # fewer within link_m: a voxel joins no two parts
    smallest_points: int = 200
    smallest_extent_m: float = 0.15  # longest side of the box about a cluster
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class Plane:
    """`normal · p = offset_m`; the normal points to where the scene lies."""

    normal: Float[np.ndarray, "3"]
    offset_m: float
    area_m2: float  # of the voxels on it
    behind: float  # share of the scene beyond it
    structure: bool  # floor, wall or ceiling: removed


@dataclass(frozen=True, kw_only=True)
class Segmentation:
    """Clusters as instances, and what was looked at."""

    instance: Int[np.ndarray, "n"]  # from 1, largest first; 0 is background
    planes: tuple[Plane, ...]
    skipped: tuple[Skipped, ...]

    def sentences(self) -> tuple[str, ...]:
        """What was removed and kept, in words."""
        removed = [_words(p) for p in self.planes if p.structure]
        kept = [_words(p) for p in self.planes if not p.structure]
        said = [f"removed as floor or wall: {'; '.join(removed) or 'no plane'}"]
        if kept:
            said.append(f"large planes kept, for part of the scene lies behind them: {'; '.join(kept)}")
        return tuple(said)


def segment_geometric(points: Float[np.ndarray, "n 3"], config: SegmentationConfig) -> Segmentation:
    """Cuts a cloud (metres, any frame) into floor, walls and clusters; the seed decides alone.

    A plane is floor, wall or ceiling if it is large and nearly nothing lies beyond it: no direction is taken
    for up, so a table top over a floor stays. Raises ValueError for a cloud too wide for the voxel grid.
    """
    if not len(points):
        return Segmentation(instance=np.zeros(0, np.int64), planes=(), skipped=())
    voxels, voxel_of = _voxels(points, config.voxel_m)
    normals = _normals(voxels, config.normal_neighbours)
    planes, structure = _planes(voxels, normals, config)
    cluster = np.full(len(voxels), -1)
    cluster[~structure] = _clusters(voxels[~structure], config)
    instance, skipped = _large_clusters(points, cluster[voxel_of], config)
    return Segmentation(instance=instance, planes=planes, skipped=skipped)


def _voxels(
    points: Float[np.ndarray, "n 3"], size_m: float
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "n"]]:
    """Centroids of the occupied voxels, in an order that does not depend on the points', and whose is whose."""
    low = points.min(axis=0)
    extent = float((points.max(axis=0) - low).max())
    if extent > size_m * LARGEST_GRID:
        raise ValueError(f"the cloud measures {extent:.4g} m; needed at most {size_m * LARGEST_GRID:.4g} m")
    cell = np.floor((points - low) / size_m).astype(np.int64)
    key = (cell[:, 0] << 42) + (cell[:, 1] << 21) + cell[:, 2]
    _, voxel_of, count = np.unique(key, return_inverse=True, return_counts=True)
    sums = [np.bincount(voxel_of, points[:, axis]) for axis in range(3)]
    return np.stack(sums, axis=-1) / count[:, None], voxel_of


def _normals(voxels: Float[np.ndarray, "v 3"], neighbours: int) -> Float[np.ndarray, "v 3"]:
    """Direction of least spread among the nearest voxels; its sign means nothing."""
    k = min(neighbours, len(voxels))
    near = cKDTree(voxels).query(voxels, k=k)[1].reshape(len(voxels), k)
    centred = voxels[near] - voxels[near].mean(axis=1, keepdims=True)
    return np.linalg.eigh(np.einsum("vki,vkj->vij", centred, centred))[1][:, :, 0]


# --- planes -------------------------------------------------------------------------------------------------


def _planes(
    voxels: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"], config: SegmentationConfig
) -> tuple[tuple[Plane, ...], Bool[np.ndarray, "v"]]:
    """The largest planes one after the other, and the voxels on or beyond those that are structure."""
    rng = np.random.default_rng(config.seed)
    free = np.ones(len(voxels), bool)  # not yet on any plane
    structure = np.zeros(len(voxels), bool)
    planes: list[Plane] = []
    for _ in range(config.planes):
        if (found := _largest_plane(voxels, normals, free, config, rng)) is None:
            break
        normal, offset = found
        on = _on_plane(voxels, normals, normal, offset, config)
        area = float((on & free).sum()) * config.voxel_m**2
        if area < config.structure_area_m2:
            break
        height = voxels @ normal - offset
        sides = np.array(
            [(height < -config.plane_distance_m).mean(), (height > config.plane_distance_m).mean()]
        )
        sign = -1.0 if sides[0] > sides[1] else 1.0
        is_structure = bool(sides.min() <= config.behind_share)
        if is_structure:
            structure |= on | (sign * height < -config.plane_distance_m)
        free &= ~on
        planes.append(
            Plane(
                normal=sign * normal,
                offset_m=sign * offset,
                area_m2=area,
                behind=float(sides.min()),
                structure=is_structure,
            )
        )
    return tuple(planes), structure


def _largest_plane(
    voxels: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    free: Bool[np.ndarray, "v"],
    config: SegmentationConfig,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "3"], float] | None:
    """RANSAC with one voxel and its normal a try; the best is fitted again to the voxels on it."""
    rows = np.flatnonzero(free)
    if len(rows) * config.voxel_m**2 < config.structure_area_m2:
        return None
    tries = rng.choice(rows, config.plane_tries)
    judges = rng.choice(rows, min(len(rows), 6000), replace=False)
    tried = normals[tries]
    offsets = np.einsum("ti,ti->t", voxels[tries], tried)
    near = np.abs(voxels[judges] @ tried.T - offsets) < config.plane_distance_m
    along = np.abs(normals[judges] @ tried.T) > np.cos(np.deg2rad(config.plane_angle_deg))
    best = int((near & along).sum(axis=0).argmax())
    normal, offset = tried[best], float(offsets[best])
    for _ in range(3):
        on = voxels[_on_plane(voxels, normals, normal, offset, config) & free]
        if len(on) < 3:
            return None
        center = on.mean(axis=0)
        normal = np.linalg.eigh((on - center).T @ (on - center))[1][:, 0]
        offset = float(center @ normal)
    return normal, offset


def _on_plane(
    voxels: np.ndarray, normals: np.ndarray, normal: np.ndarray, offset: float, config: SegmentationConfig
) -> Bool[np.ndarray, "v"]:
    near = np.abs(voxels @ normal - offset) < config.plane_distance_m
    return near & (np.abs(normals @ normal) > np.cos(np.deg2rad(config.plane_angle_deg)))


def _words(plane: Plane) -> str:
    normal = ", ".join(f"{c:.2f}" for c in plane.normal + 0.0)
    return f"{plane.area_m2:.1f} m² facing ({normal}) with {100 * plane.behind:.1f} % of the scene behind"


# --- clusters -----------------------------------------------------------------------------------------------


def _clusters(voxels: Float[np.ndarray, "v 3"], config: SegmentationConfig) -> Int[np.ndarray, "v"]:
    """DBSCAN: parts that well-surrounded voxels connect; -1 for voxels near none of those."""
    cluster = np.full(len(voxels), -1)
    if not len(voxels):
        return cluster
    pairs = cKDTree(voxels).query_pairs(config.link_m, output_type="ndarray")
    core = np.bincount(pairs.ravel(), minlength=len(voxels)) >= config.core_neighbours
    if not core.any():
        return cluster
    a, b = pairs[core[pairs].all(axis=1)].T
    graph = coo_matrix((np.ones(len(a), bool), (a, b)), shape=(len(voxels), len(voxels)))
    cluster[core] = connected_components(graph, directed=False)[1][core]
    rest = np.flatnonzero(~core)
    distance, nearest = cKDTree(voxels[core]).query(voxels[rest], distance_upper_bound=config.link_m)
    reached = np.isfinite(distance)
    cluster[rest[reached]] = cluster[core][nearest[reached]]
    return cluster


def _large_clusters(
    points: Float[np.ndarray, "n 3"], cluster: Int[np.ndarray, "n"], config: SegmentationConfig
) -> tuple[Int[np.ndarray, "n"], tuple[Skipped, ...]]:
    """Clusters large enough to be objects, numbered from 1 by their points; the others in one line."""
    order = np.argsort(cluster, kind="stable")
    ids, starts = np.unique(cluster[order], return_index=True)
    groups = [rows for i, rows in zip(ids, np.split(order, starts[1:]), strict=True) if i >= 0]
    large = [
        rows
        for rows in groups
        if len(rows) >= config.smallest_points
        and np.ptp(points[rows], axis=0).max() >= config.smallest_extent_m
    ]
    instance = np.zeros(len(points), np.int64)
    for number, rows in enumerate(sorted(large, key=len, reverse=True), 1):
        instance[rows] = number
    if not (small := len(groups) - len(large)):
        return instance, ()
    reason = f"fewer than {config.smallest_points} points or smaller than {config.smallest_extent_m:g} m"
    return instance, (Skipped(what=f"{small} small clusters", reason=reason),)
