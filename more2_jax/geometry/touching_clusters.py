"""What of a scan touches: DBSCAN whose radius follows the spacing of the points, walls left out of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Integer
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree

from more2_jax.geometry.boundary_planes import Plane
from more2_jax.geometry.segmentation_config import SegmentationConfig


def clusters_off_planes(
    voxels: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    near_m: csr_matrix,
    core: Bool[np.ndarray, "v"],
    planes: Sequence[Plane],
    config: SegmentationConfig,
) -> Integer[np.ndarray, "v"]:
    """Clusters of what is `touching`, from 0, -1 for noise; what lies beside a wall joins no two.

    Strips of walls and floors that are left over touch all that stands along them. What lies beside the planes that
    are structure belongs to the part that it touches on a short way; the rest of it is clustered by itself.
    """
    cluster = np.full(len(voxels), -1)
    beside = beside_planes(voxels, normals, planes, config)
    _connect(cluster, near_m, core & ~beside)
    if (cluster >= 0).any() and beside.any():
        off = np.flatnonzero(cluster >= 0)
        limit = {"limit": config.beside_reach_m, "min_only": True, "return_predecessors": True}
        way_m, _, begun = dijkstra(near_m, directed=False, indices=off, **limit)
        reached = core & beside & np.isfinite(way_m)
        cluster[reached] = cluster[begun[reached]]
    _connect(cluster, near_m, core & (cluster < 0))
    return _with_rim(voxels, cluster, core, config)


def beside_planes(
    voxels: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    planes: Sequence[Plane],
    config: SegmentationConfig,
) -> Bool[np.ndarray, "v"]:
    """Which voxels lie along a floor or wall, or near two: what stands before a wall faces other ways."""
    along, near = np.zeros(len(voxels), bool), np.zeros(len(voxels), int)
    for plane in (p for p in planes if p.structure):
        of_plane = np.abs(voxels @ plane.normal - plane.offset_m) < config.beside_m
        along |= of_plane & (np.abs(normals @ plane.normal) > np.cos(np.deg2rad(config.beside_deg)))
        near += of_plane
    return along | (near > 1)


def touching(
    voxels: Float[np.ndarray, "v 3"], counts: Integer[np.ndarray, "v"], config: SegmentationConfig
) -> tuple[csr_matrix, Bool[np.ndarray, "v"]]:
    """How far voxels lie that touch (`counts` of points each), and which have neighbors enough (DBSCAN's core).

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
