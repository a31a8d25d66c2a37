"""Objects that a scan shows and has no mask of: sought in its background where another scan's object is missing.

Beyond the paper, which takes every object to have a mask. What is missing may have been overlooked by what made the
masks. Clusters of the background are compared with it as instances are; those that nothing missing explains stay
background.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool
from scipy.spatial import KDTree

from more2_jax.config import MotionModel
from more2_jax.geometry.near_points import rms_radius
from more2_jax.geometry.poses import Points, apply_pose
from more2_jax.geometry.segmentation import segment_geometric
from more2_jax.geometry.segmentation_config import SegmentationConfig
from more2_jax.geometry.voxels import LARGEST_GRID
from more2_jax.matching.candidates import portable
from more2_jax.network.embedding_batch import embed
from more2_jax.network.prior import Prior
from more2_jax.tracking.comparison import Comparison
from more2_jax.tracking.looked_at import LEAST_BACKGROUND, clouds_of
from more2_jax.tracking.objects import new_object, next_number
from more2_jax.tracking.regrouped import Regrouped
from more2_jax.types import Embedding, Instance, ObservedObject, Scan, ScanRecord, SceneObject

# Chosen on rooms of regime `real` with missed masks, docs/developing/notebook/mask_missed.md.
MOST_POINTS = 300_000  # of a background that are looked at: some two centimeters apart in a room
MASK_POINTS = 5_000  # of a mask that tell what lies beside it
BESIDE_M = 0.05  # of a mask: what it left of its own object
PROMISING = 3.0  # log odds below an even chance: a cluster that also holds something else
REACH = 0.6  # shares of the missing object's radius: what lies farther from it is something else
SAME_M = 1e-6  # nearer points are one
MOST_COMMON = 0.2  # share of its points that a cloud may have in common with another one
# Log odds beyond an even chance that are asked of small things, which look alike and of which rooms hold many,
SMALL = 2.5
TURNED = 0.5  # in any orientation, in which more clusters fit something,
REST = 1.0  # and of what may be the rest of an object whose mask is cut:
REST_M = 0.12  # so near a mask lies
LEAST_REST = 0.05  # such a share of its points


@dataclass(frozen=True, kw_only=True)
class Thing:
    """A cluster of a background, or a part of one."""

    points: Points
    rest: bool = False  # whether it lies beside a mask, and may be what that left of its own object


@dataclass(frozen=True, kw_only=True)
class Explained:
    """A part of a background that is what is missing in the other scan, by its row there."""

    row: int
    points: Points
    embedding: Embedding


def add_unmasked(
    whole: Regrouped, compared: Comparison, scans: Sequence[ScanRecord], scan: Scan
) -> Regrouped | None:
    """Adds instances that the scan, and objects that the scan before, shows without a mask; None of none.

    `scans`: those before, in the order of time. What is added stands last, and goes again (`without_unfound`) if it is
    not found to be what was missing.
    """
    gone, new = sorted(compared.identified.gone), sorted(compared.identified.new)
    free = things(scan.background, [i.points for i in whole.instances]) if gone else []
    instances = explained(compared, [compared.old[k] for k in gone], free, instances=True)
    seen = clouds_of(whole.objects, scans[-1]) if new else iter([scan.background[:0]])
    free = things(next(seen), seen)
    before = explained(compared, [compared.new[i] for i in new], free, instances=False)
    if not instances and not before:
        return None
    first = 1 + max((i.id for i in scan.instances), default=0)
    return dataclasses.replace(
        whole,
        instances=[
            *whole.instances,
            *(Instance(id=first + n, points=e.points) for n, e in enumerate(instances)),
        ],
        embeddings=[*whole.embeddings, *(e.embedding for e in instances)],
        objects=[*whole.objects, *objects_before(whole.objects, before, scans)],
        unmasked=(len(before), len(instances)),
    )


def objects_before(
    objects: Sequence[SceneObject], found: Sequence[Explained], scans: Sequence[ScanRecord]
) -> list[SceneObject]:
    """What the scan before shows without a mask, as objects that it saw first; points in the scene's frame."""
    scan, number = scans[-1], next_number(objects, scans)
    seen = [s.instance for o in objects for s in o.observations if s.scan == scan.index]
    first, made = 1 + max((*scan.instances, *seen), default=0), list[SceneObject]()
    for n, e in enumerate(found):
        o = new_object(
            number + n, scan.index, Instance(id=first + n, points=e.points), e.embedding, scan.frame
        )
        own = dataclasses.replace(o.observations[0], T_ref_scan=scan.frame.T_scene_scan)
        made.append(dataclasses.replace(o, observations=(own,)))
    return made


def not_sought(whole: Regrouped, scans: Sequence[ScanRecord]) -> dict[int, tuple[str, ...]]:
    """By scan before the last, the objects that the last shows without a mask: nobody sought them in those."""
    added = tuple(o.id for o in whole.unmasked_objects())
    return {s.index: added for s in scans[:-1]} if added else {}


def without_unfound(whole: Regrouped, compared: Comparison) -> Regrouped | None:
    """Without what was added and is none of what was missing; None if all is."""
    masked = len(whole.objects) - whole.unmasked[0], len(whole.instances) - whole.unmasked[1]
    found = [(f.object, f.instance) for f in compared.identified.found]
    found = [pair for pair in found if pair[0] < masked[0] or pair[1] < masked[1]]  # one of them has a mask
    objects, instances = (
        [row for row in range(count) if row < first or row in {pair[side] for pair in found}]
        for side, (count, first) in enumerate(
            zip((len(whole.objects), len(whole.instances)), masked, strict=True)
        )
    )
    left = len(objects) - masked[0], len(instances) - masked[1]
    if left == whole.unmasked:
        return None
    return dataclasses.replace(
        whole,
        objects=[whole.objects[k] for k in objects],
        instances=[whole.instances[i] for i in instances],
        embeddings=[whole.embeddings[i] for i in instances],
        unmasked=left,
    )


def things(background: Points, masks: Iterable[Points]) -> list[Thing]:
    """Clusters of what is neither floor nor wall, nor lies on a mask. Masks are let go of one by one."""
    if len(background) < LEAST_BACKGROUND:
        return []
    background = background[:: -(-len(background) // MOST_POINTS)]
    off = np.full(len(background), np.inf)
    if few := [m[:: -(-len(m) // MASK_POINTS)].copy() for m in masks if len(m)]:
        off = KDTree(np.concatenate(few)).query(background, distance_upper_bound=REST_M)[0]
    free, off, config = background[off > BESIDE_M], off[off > BESIDE_M], SegmentationConfig()
    if not len(free) or np.ptp(free, axis=0).max() > config.voxel_m * LARGEST_GRID:
        return []  # something strays kilometers away
    cluster = segment_geometric(free, config).instance
    every = (cluster == k for k in range(1, 1 + cluster.max(initial=0)))
    return [Thing(points=free[c], rest=bool(np.isfinite(off[c]).mean() > LEAST_REST)) for c in every]


def explained(
    compared: Comparison, missing: Sequence[ObservedObject], clusters: Sequence[Thing], *, instances: bool
) -> list[Explained]:
    """Which clusters, or parts of them, are what is missing; every point and every object once, the likeliest first.

    `instances`: the clusters are the new scan's, in its frame; else the scan's before, in the scene's.
    """
    parts = parts_like(compared, missing, clusters, instances=instances)
    clouds = observed(compared.prior, parts)
    odds = odds_with(compared, missing, clouds, instances)
    found, taken = list[Explained](), np.zeros((0, 3))
    for (row, n), value in sorted(odds.items(), key=lambda x: -x[1]):
        points = parts[n].points
        asked = compared.even_odds + doubt(parts[n], missing[row], compared.config.motion)
        if value < asked or row in [e.row for e in found]:
            continue
        common = np.isfinite(KDTree(taken).query(points, distance_upper_bound=SAME_M)[0]).mean()
        if common <= MOST_COMMON:
            found.append(Explained(row=row, points=points, embedding=clouds[n].embedding))
            taken = np.concatenate([taken, points])
    return found


def doubt(thing: Thing, missing: ObservedObject, motion: MotionModel) -> float:
    """Log odds beyond an even chance that a thing needs to be what is missing."""
    longest = max(np.ptp(p, axis=0).max() for p in (thing.points, missing.points))
    small = SMALL * float(portable(np.array([longest]))[0])
    return small + REST * thing.rest + TURNED * (motion == "free")


def parts_like(
    compared: Comparison, missing: Sequence[ObservedObject], clusters: Sequence[Thing], *, instances: bool
) -> list[Thing]:
    """The clusters that may be something missing, each without what lies far from that where it fits best."""
    fewest = compared.config.min_points
    clusters = [c for c in clusters if len(c.points) >= fewest]
    if not missing or not clusters:
        return []
    clouds, parts = observed(compared.prior, clusters), list[Thing]()
    poses = compared.poses_of_others(*((missing, clouds) if instances else (clouds, missing)))
    for (k, i), (odds, T_old_new) in poses.items():
        row, of = (k, i) if instances else (i, k)
        there = apply_pose(np.linalg.inv(T_old_new) if instances else T_old_new, missing[row].points)
        near = near_to(there, clusters[of].points)
        if odds >= compared.even_odds - PROMISING and near.sum() >= fewest:
            parts.append(dataclasses.replace(clusters[of], points=clusters[of].points[near]))
    return parts


def near_to(whole: Points, points: Points) -> Bool[np.ndarray, " n"]:
    """Which points may be an object's, placed there, be they of sides that it has not shown."""
    reach_m = REACH * rms_radius(whole)
    return np.isfinite(KDTree(whole).query(points, distance_upper_bound=reach_m)[0])


def odds_with(
    compared: Comparison, missing: Sequence[ObservedObject], clouds: Sequence[ObservedObject], instances: bool
) -> dict[tuple[int, int], float]:
    """Log odds of what is missing and clouds to be one object, by their rows."""
    if not missing or not clouds:
        return {}
    if instances:
        return compared.odds_of_others(missing, clouds)
    return {(row, k): z for (k, row), z in compared.odds_of_others(clouds, missing).items()}


def observed(prior: Prior, parts: Sequence[Thing]) -> list[ObservedObject]:
    """Parts of a background as matching takes them; nothing is known of their normals."""
    clouds = [p.points for p in parts]
    codes = embed(prior, clouds, [None] * len(clouds)) if clouds else []
    return [ObservedObject(points=p, embedding=e) for p, e in zip(clouds, codes, strict=True)]
