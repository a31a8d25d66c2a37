"""Instances from time, without a network: of scans of one room, what changed is an object, what stayed is clustered.

A voxel that another scan shows to be empty has changed. Between what changed and what stayed a minimal cut (Boykov and
Jolly, 2001) runs along concave creases, so that a table moved by less than its width stays whole. Both sides are then
clustered as in `geometry.segmentation`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int8, Integer
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow
from scipy.spatial import KDTree

from more2_jax.geometry.boundary_planes import boundary_planes
from more2_jax.geometry.poses import Points, Pose
from more2_jax.geometry.room_alignment import (
    RoomFit,
    RoomShape,
    fit_as_given,
    fit_from_any_yaw,
    room_shape,
)
from more2_jax.geometry.segmentation import Segmentation, clustered, numbered, small_joined, without_flat
from more2_jax.geometry.segmentation_config import SegmentationConfig
from more2_jax.scans.seen_empty import (
    EMPTIED,
    STAYED,
    UNKNOWN,
    Surface,
    UnlabeledScan,
    empty_before,
    states,
    surface_of,
)

MOST = 0.5  # share of a cluster's voxels on the side of what changed: it is no part of a wall
CHANGED = (
    0.4  # share of an instance's voxels that another scan shows empty, from which it is said to have changed
)
ALONE = (
    "it does not lie on the other scans in any one pose, and is cut as by --segment geometric; changes between scans"
    " need scans that show the same floor and walls, each with z up or all in one frame"
)
CAPACITY = 100  # of the whole-numbered flow, for a weight of 1


@dataclass(frozen=True)
class ChangeConfig:
    """Settings of `segment_changes`; weights of the cut are relative to that of a voxel that was seen empty.

    Chosen on rooms of regime `real`, seed 404 (`eval.segmentation`): half and twice of each changes little.
    """

    stayed_weight: float = (
        0.5  # of a voxel with the other scan's surface: another object may have stood there
    )
    unknown_weight: float = 0.1  # of one where the other scan did not look, for having stayed
    smooth_weight: float = 10.0  # of two neighbors on one surface, for belonging together
    crease_decay: float = 4.0  # by which that falls with the sine of a concave crease, as exp(−decay · sine),
    crease_weight: float = 0.02  # to this share of it
    link_m: float = 0.07  # neighbors of the cut are within,
    neighbors: int = 8  # and among the nearest
    clusters: SegmentationConfig = field(
        default_factory=SegmentationConfig
    )  # its voxels are those of `seen_empty`


@dataclass(frozen=True, kw_only=True)
class TemporalSegmentation(Segmentation):
    """Instances of one scan among several, and which of them changed."""

    emptied: Float[np.ndarray, " k"]  # share of each instance's voxels that another scan shows empty
    changed: Bool[np.ndarray, " k"]  # of instances 1 to k
    T_first_scan: (
        Pose | None
    )  # how the scan lies in the first one's frame; None: it lies on none in any one pose

    def sentences(self) -> tuple[str, ...]:
        """What changed, and what was removed and kept, in words."""
        if self.T_first_scan is None:
            return (ALONE, *super().sentences())
        ids = ", ".join(str(k) for k in np.flatnonzero(self.changed) + 1)
        return (f"instances that changed between scans: {ids or 'none'}", *super().sentences())


def segment_changes(
    scans: Sequence[UnlabeledScan], config: ChangeConfig | None = None
) -> tuple[TemporalSegmentation, ...]:
    """Cuts scans of one room, each into instances of its own, by what changed between them.

    Scans lie in any frames: as given where they fit, else leveled and turned until they do (`one_frame`). One that
    fits none is cut alone, and nothing of it is said to have changed. Ids are those of one scan: who is who is left to
    matching. What a scan did not look at is no change.
    Raises ValueError for fewer than two scans, an empty one, and one too wide for the grid.
    """
    config = config or ChangeConfig()
    if len(scans) < 2 or not all(len(s.points) for s in scans):
        raise ValueError(
            f"{len(scans)} scans of {', '.join(str(len(s.points)) for s in scans) or 'no'} points; changes between"
            " scans need two or more, none empty"
        )
    placed = one_frame([s.points for s in scans])
    surfaces = [surface_of(s, config.clusters.voxel_m) for s in scans]
    empty = [empty_before(s) for s in surfaces]
    found = []
    for k, (surface, (first, T)) in enumerate(zip(surfaces, placed, strict=True)):
        said = [
            states(surface, surfaces[j], np.linalg.inv(other) @ T, empty[j])
            for j, (its_first, other) in enumerate(placed)
            if j != k and its_first == first
        ]
        found.append(_instances(surface, together(said, len(surface.points)), T if said else None, config))
    return tuple(found)


def one_frame(clouds: Sequence[Points]) -> list[tuple[int, Pose]]:
    """Of every scan (meters) the first that it hangs together with, itself if there is none, and `T_first_scan`.

    Frames as they are given are believed wherever they fit; only scans left over are turned.
    """
    shapes = [room_shape(p) for p in clouds]
    placed: dict[int, tuple[int, Pose]] = {}
    for first in range(len(clouds)):
        if first not in placed:
            placed |= {k: (first, T) for k, T in _hanging_together(first, shapes, placed).items()}
    return [placed[k] for k in range(len(clouds))]


def _hanging_together(
    first: int, shapes: Sequence[RoomShape | None], taken: Collection[int]
) -> dict[int, Pose]:
    """`T_first_scan` of the first scan and of those, not `taken`, that lie on it or on another that does."""
    poses: dict[int, Pose] = {first: np.eye(4)}
    ways = (fit_as_given, fit_from_any_yaw)
    while True:
        left = [k for k in range(len(shapes)) if k not in poses and k not in taken]
        # The nearest in time first: scans that follow one another have most in common.
        pairs = [(j, k) for k in left for j in sorted(poses, key=lambda j: abs(j - k))]
        fits = ((j, k, _placed(way, shapes[j], shapes[k])) for way in ways for j, k in pairs)
        if (found := next(((j, k, f) for j, k, f in fits if f is not None), None)) is None:
            return poses
        j, k, fit = found
        poses[k] = poses[j] @ fit.T_a_b


def _placed(
    way: Callable[[RoomShape, RoomShape], RoomFit | None], a: RoomShape | None, b: RoomShape | None
) -> RoomFit | None:
    return None if a is None or b is None else way(a, b)


def together(said: Sequence[Int8[np.ndarray, " v"]], count: int) -> Int8[np.ndarray, " v"]:
    """What several scans say of a scan's voxels: emptied in one of them, else there in one of them, else unknown."""
    state = np.full(count, UNKNOWN, np.int8)
    for value in (STAYED, EMPTIED):
        for one in said:
            state[one == value] = value
    return state


def _instances(
    surface: Surface, state: Int8[np.ndarray, " v"], T_first_scan: Pose | None, config: ChangeConfig
) -> TemporalSegmentation:
    """Floor and walls removed; what changed and what stayed clustered, each for itself."""
    clusters, points = config.clusters, surface.points
    planes, structure = boundary_planes(points, surface.normals, clusters)
    free = np.flatnonzero(~structure)
    moved = np.zeros(len(points), bool)
    moved[free] = moved_voxels(points[free], surface.normals[free], state[free], config)
    cluster, apart = np.full(len(points), -1), np.zeros(len(points), bool)
    for part in (moved & ~structure, ~moved & ~structure):
        own, apart[part] = clustered(
            points[part], surface.normals[part], surface.counts[part], planes, clusters
        )
        cluster[part] = np.where(own < 0, -1, own + cluster.max() + 1)
    cluster = small_joined(points, cluster, apart, clusters)
    # What lies flat on a wall and was gone before is a thing, not a bend of the wall.
    thing = (cluster >= 0) & (_share(moved, cluster)[cluster] > MOST)
    cluster = np.where(thing, cluster, without_flat(points, cluster, planes, clusters))
    instance, skipped = numbered(points, cluster, surface.voxel_of, clusters)
    of_voxel = np.zeros(len(points), np.int64)
    of_voxel[surface.voxel_of] = instance
    emptied = _share(state == EMPTIED, of_voxel - 1)[: instance.max(initial=0)]
    return TemporalSegmentation(
        instance=instance,
        planes=planes,
        skipped=skipped,
        emptied=emptied,
        changed=emptied >= CHANGED,
        T_first_scan=T_first_scan,
    )


def _share(of: Bool[np.ndarray, " v"], cluster: Integer[np.ndarray, " v"]) -> Float[np.ndarray, " k"]:
    """Share of each cluster's voxels for which `of` is true; a last 0 for those of none (−1)."""
    rows = cluster >= 0
    total = np.bincount(cluster[rows], minlength=cluster.max(initial=-1) + 2)
    return np.bincount(cluster[rows], of[rows], minlength=len(total)) / np.maximum(total, 1)


# --- the cut ------------------------------------------------------------------------------------------------


def moved_voxels(
    points: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    state: Int8[np.ndarray, " v"],
    config: ChangeConfig,
) -> Bool[np.ndarray, " v"]:
    """Which voxels belong to what changed: the labeling of least cost, by a minimal cut."""
    if not (state == EMPTIED).any():
        return np.zeros(len(points), bool)
    a, b, weight = creased_graph(points, normals, config)
    count = len(points)
    source, sink, every = np.full(count, count), np.full(count, count + 1), np.arange(count)
    gone = np.where(state == EMPTIED, 1.0, 0.0)
    stays = np.select([state == STAYED, state == UNKNOWN], [config.stayed_weight, config.unknown_weight], 0.0)
    rows = np.concatenate([a, b, source, every])
    columns = np.concatenate([b, a, every, sink])
    capacity = np.round(CAPACITY * np.concatenate([weight, weight, gone, stays])).astype(np.int32)
    graph = coo_matrix((capacity, (rows, columns)), shape=(count + 2, count + 2)).tocsr()
    left = graph - maximum_flow(graph, count, count + 1).flow
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    reached = np.zeros(count + 2, bool)
    reached[breadth_first_order(left, count, return_predecessors=False)] = True
    return reached[:count]


def creased_graph(
    points: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"], config: ChangeConfig
) -> tuple[Integer[np.ndarray, " e"], Integer[np.ndarray, " e"], Float[np.ndarray, " e"]]:
    """Neighbors, each pair once, and how much they belong together: little across a concave crease.

    Normals of a concave crease turn toward one another along the line between its sides, as where a box stands on a
    table; those of an edge of one thing turn apart (convexity as in Stein et al., 2014).
    """
    k = min(config.neighbors + 1, len(points))
    distance, near = (np.asarray(x).reshape(len(points), k) for x in KDTree(points).query(points, k=k))
    a, slot = np.nonzero((distance < config.link_m) & (near != np.arange(len(points))[:, None]))
    pair = np.sort(np.stack([a, near[a, slot]], axis=-1), axis=1)
    _, first = np.unique(pair[:, 0] * len(points) + pair[:, 1], return_index=True)
    a, b = pair[first].T
    line = points[b] - points[a]
    line /= np.maximum(np.linalg.norm(line, axis=1, keepdims=True), 1e-9)
    concave = np.maximum(np.einsum("ei,ei->e", normals[a] - normals[b], line), 0.0)
    weight = np.maximum(np.exp(-config.crease_decay * concave), config.crease_weight)
    return a, b, config.smooth_weight * weight
