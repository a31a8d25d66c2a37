"""Instances without a network: large planes at the boundary of the scene removed, the rest clustered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Integer
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree

from more2_jax.geometry.voxels import voxel_means, voxel_normals
from more2_jax.types import Skipped


@dataclass(frozen=True)
class SegmentationConfig:
    """Settings of `segment_geometric`; lengths in meters."""

    voxel_m: float = 0.03
    normal_neighbors: int = 20
    plane_distance_m: float = 0.05  # a voxel this near belongs to the plane
    plane_angle_deg: float = 30.0  # and if its normal turns less than this from the plane's
    plane_tries: int = 400
    planes: int = 12  # looked at, whether removed or not
    structure_area_m2: float = 0.6  # smaller planes are parts of objects
    behind_share: float = 0.04  # of the scene may lie beyond a floor or wall
    structure_share: float = 0.35  # of the scene's extent that a floor or wall spans at least
    room_m: float = 1.8  # floor and ceiling, or two facing walls, are this far apart: a table top is neither
    link_m: float = 0.06  # voxels this near touch where points are dense
    dense_points: float = 3.0  # a voxel, on average among neighbors
    link_spacing: float = 1.0  # where points are sparse: times the distance of the last core neighbor
    largest_link_m: float = 0.2
    beside_m: float = 0.12  # what lies this close to a floor or wall joins no two parts,
    beside_reach_m: float = 0.2  # and belongs to a part that it touches along this way
    core_neighbors: int = 9  # fewer within reach: a voxel joins no two parts
    join_area_m2: float = 0.1  # a smaller cluster is a piece of a neighbor
    join_m: float = 0.15  # if one is this near
    flat_m: float = 0.15  # a cluster that lies this close to a floor or wall is a part of it
    flat_share: float = 0.9  # with this share of its voxels
    smallest_area_m2: float = 0.03  # of its voxels
    smallest_extent_m: float = 0.2
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

    instance: Integer[np.ndarray, "n"]  # from 1, largest first; 0 is background
    planes: tuple[Plane, ...]
    skipped: tuple[Skipped, ...]

    def sentences(self) -> tuple[str, ...]:
        """What was removed and kept, in words."""
        removed = [_words(p) for p in self.planes if p.structure]
        kept = [_words(p) for p in self.planes if not p.structure]
        said = [f"removed as floor or wall: {'; '.join(removed) or 'no plane'}"]
        if kept:
            said.append(f"large planes kept as parts of objects: {'; '.join(kept)}")
        return tuple(said)


def segment_geometric(points: Float[np.ndarray, "n 3"], config: SegmentationConfig) -> Segmentation:
    """Cuts a cloud (meters, any frame) into floor, walls and clusters; the seed decides alone.

    A plane is floor, wall or ceiling if it is large, spans much of the scene, has nearly nothing beyond it, and
    is not just over or before another: no direction is taken for up, and a table top over a floor stays. How far
    apart two voxels of one part may be grows where points are sparse, as far from a camera.
    Raises ValueError for a cloud too wide for the voxel grid.
    """
    if not len(points):
        return Segmentation(instance=np.zeros(0, np.int64), planes=(), skipped=())
    voxels, voxel_of = voxel_means(points, config.voxel_m)
    normals = voxel_normals(voxels, config.normal_neighbors)
    planes, structure = boundary_planes(voxels, normals, config)
    cluster = np.full(len(voxels), -1)
    counts = np.bincount(voxel_of)
    cluster[~structure] = clusters_off_planes(voxels[~structure], counts[~structure], planes, config)
    cluster = without_flat(voxels, small_joined(voxels, cluster, config), planes, config)
    instance, skipped = numbered(voxels, cluster, voxel_of, config)
    return Segmentation(instance=instance, planes=planes, skipped=skipped)


def _extent(points: Float[np.ndarray, "n 3"]) -> float:
    """Length along the direction of greatest spread, in any frame the same."""
    if not len(points):
        return 0.0
    centered = points - points.mean(axis=0)
    return float(np.ptp(centered @ np.linalg.eigh(centered.T @ centered)[1][:, -1]))


# --- planes -------------------------------------------------------------------------------------------------


def boundary_planes(
    voxels: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"], config: SegmentationConfig
) -> tuple[tuple[Plane, ...], Bool[np.ndarray, "v"]]:
    """The largest planes one after the other, and the voxels on or beyond those that are structure."""
    rng = np.random.default_rng(config.seed)
    free = np.ones(len(voxels), bool)  # not yet on any plane
    structure = np.zeros(len(voxels), bool)
    planes: list[Plane] = []
    scene_m = _extent(voxels)
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
        plane = Plane(
            normal=sign * normal,
            offset_m=sign * offset,
            area_m2=area,
            behind=float(sides.min()),
            structure=False,
        )
        wide = _extent(voxels[on]) >= config.structure_share * scene_m
        if wide and plane.behind <= config.behind_share and not _before_another(plane, planes, config):
            plane = replace(plane, structure=True)
            structure |= on | (sign * height < -config.plane_distance_m)
        free &= ~on
        planes.append(plane)
    return tuple(planes), structure


def _before_another(plane: Plane, planes: list[Plane], config: SegmentationConfig) -> bool:
    """Whether it faces a floor or wall from nearer than a room is wide: a table top, a cabinet's door."""
    return any(
        p.structure
        and p.normal @ plane.normal < -np.cos(np.deg2rad(config.plane_angle_deg))
        and -plane.offset_m - p.offset_m < config.room_m
        for p in planes
    )


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


def clusters_off_planes(
    voxels: Float[np.ndarray, "v 3"],
    counts: Integer[np.ndarray, "v"],
    planes: Sequence[Plane],
    config: SegmentationConfig,
) -> Integer[np.ndarray, "v"]:
    """Clusters of what touches (`counts` of points a voxel), -1 for noise; what lies beside a wall joins no two.

    Strips of walls and floors that are left over touch all that stands along them. What lies beside the planes that
    are structure belongs to the part that it touches on a short way; the rest of it is clustered by itself.
    """
    cluster = np.full(len(voxels), -1)
    if len(voxels) <= config.core_neighbors:
        return cluster
    near_m, core = touching(voxels, counts, config)
    beside = np.zeros(len(voxels), bool)
    for plane in (p for p in planes if p.structure):
        beside |= np.abs(voxels @ plane.normal - plane.offset_m) < config.beside_m
    _connect(cluster, near_m, core & ~beside)
    if (cluster >= 0).any() and beside.any():
        off = np.flatnonzero(cluster >= 0)
        limit = {"limit": config.beside_reach_m, "min_only": True, "return_predecessors": True}
        way_m, _, begun = dijkstra(near_m, directed=False, indices=off, **limit)
        reached = core & beside & np.isfinite(way_m)
        cluster[reached] = cluster[begun[reached]]
    _connect(cluster, near_m, core & (cluster < 0))
    return _with_rim(voxels, cluster, core, config)


def touching(
    voxels: Float[np.ndarray, "v 3"], counts: Integer[np.ndarray, "v"], config: SegmentationConfig
) -> tuple[csr_matrix, Bool[np.ndarray, "v"]]:
    """How far voxels lie that touch, and which have neighbors enough (DBSCAN's core).

    The radius follows the spacing of the points: a scan has few of them far from its camera.
    """
    k = min(config.normal_neighbors, len(voxels) - 1)
    distance, near = (np.asarray(found)[:, 1:] for found in KDTree(voxels).query(voxels, k=k + 1))
    last = distance[:, config.core_neighbors - 1]
    dense = counts[near[:, : config.core_neighbors]].mean(axis=1) >= config.dense_points
    sparse_reach = np.clip(config.link_spacing * last, config.link_m, config.largest_link_m)
    reach = np.where(dense, config.link_m, sparse_reach)
    core = last <= reach
    # The lesser reach of two decides: stray points between two objects reach far, the objects do not.
    linked = (distance <= np.minimum(reach[:, None], reach[near])) & core[near] & core[:, None]
    a, slot = np.nonzero(linked)
    return csr_matrix((distance[a, slot], (a, near[a, slot])), shape=(len(voxels), len(voxels))), core


def _connect(cluster: Integer[np.ndarray, "v"], near_m: csr_matrix, rows: Bool[np.ndarray, "v"]) -> None:
    """Gives those rows that hang together new clusters."""
    own = connected_components(near_m[rows][:, rows], directed=False)[1]
    cluster[rows] = own + cluster.max(initial=-1) + 1


def _with_rim(
    voxels: Float[np.ndarray, "v 3"],
    cluster: Integer[np.ndarray, "v"],
    core: Bool[np.ndarray, "v"],
    config: SegmentationConfig,
) -> Integer[np.ndarray, "v"]:
    """Voxels that are no core, too, each in the cluster that it lies at."""
    rest, cluster = np.flatnonzero(~core), cluster.copy()
    if len(rest) and core.any():
        tree = KDTree(voxels[core])
        gap, nearest = map(np.asarray, tree.query(voxels[rest], distance_upper_bound=config.link_m))
        reached = np.isfinite(gap)
        cluster[rest[reached]] = cluster[core][nearest[reached]]
    return cluster


def small_joined(
    voxels: Float[np.ndarray, "v 3"], cluster: Integer[np.ndarray, "v"], config: SegmentationConfig
) -> Integer[np.ndarray, "v"]:
    """Pieces given to the nearest other cluster, the smallest first: a leg to its table."""
    cluster = cluster.copy()
    ids, counts = np.unique(cluster[cluster >= 0], return_counts=True)
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
    """Without patches of floors and walls: sensors warp a wall at the border of their view."""
    cluster = cluster.copy()
    for plane in planes:
        if plane.structure:
            clustered = cluster >= 0
            total = np.bincount(cluster[clustered], minlength=1)
            near = clustered & (np.abs(voxels @ plane.normal - plane.offset_m) < config.flat_m)
            flat = np.bincount(cluster[near], minlength=len(total)) > config.flat_share * total
            cluster[clustered & flat[cluster]] = -1
    return cluster


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
    return area >= config.smallest_area_m2 and _extent(voxels) >= config.smallest_extent_m
