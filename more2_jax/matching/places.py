"""What the places of things say of who is who, once it is known how a scan lies: most things stay where they were.

Beyond the paper (`EvidenceMatcher`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Set

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from more2_jax.config import EvidenceMatcher, MotionModel
from more2_jax.geometry.near_points import rms_radius
from more2_jax.geometry.poses import Points, Pose, apply_pose
from more2_jax.matching.assignment import FARTHEST_M
from more2_jax.matching.calibration import Compared
from more2_jax.matching.candidates import AlignedPairs, aligned_pairs
from more2_jax.matching.metric_evidence import APART_M, MetricEvidence, Seen
from more2_jax.matching.proposals import Proposed, signatures
from more2_jax.network.prior import Prior

# How far what did not move may seem to have moved, and its center where it also seems to have turned.
STAYED_M, STAYED_DEG, STAYED_TURNED_M = 0.15, 10.0, 0.06
OTHER_COLOR = -1.0  # log likelihood ratio: what has less is of another color
# Of what a meter costs, in any orientation: without heights right pairs are less sure of one another, and four meters
# outvoted them (docs/developing/notebook/places.md).
FREE_SHARE = 0.25
# Two things are not in one place. A sliver is unlike the whole, but lies on it where nothing moved
# (docs/developing/notebook/perfect_masks.md).
IN_PLACE_M = 0.04  # a point so near the other cloud lies on it,
IN_PLACE_RADII = 0.1  # and within such a share of the larger cloud's radius
IN_PLACE_SHARE = 0.7  # of one cloud: if so much lies on the other, both are in one place
IN_PLACE = 3.0  # log odds of such a pair, beyond an even chance
MOST_EMPTY = 2 / 3  # of a cloud, by the other scan: if more is empty, its mask holds something else, too
BY_PAIR = ("rows", "T_old_new", "top_gap_m", "off", "off_own")  # arrays of `AlignedPairs`
BESIDE_M = 0.6  # centers of an object and of what a damaged mask shows of it, where it was
LARGE_BESIDE = 0.5  # centers of large ones are farther apart: so much of one cloud lies on the other then
FEW_POINTS = 200  # of a cloud, of which the share that lies on another one is told


def motion_odds(
    aligned: AlignedPairs, T_scene_scan: Pose, matcher: EvidenceMatcher, motion: MotionModel
) -> Float[np.ndarray, " p"]:
    """Log odds of how every pair moved, if it is one object, the scan lying at `T_scene_scan`: few things go far."""
    moved_m = np.minimum(distances_m(aligned, T_scene_scan, aligned.rows), FARTHEST_M)
    a_meter = matcher.motion_weight * (1.0 if motion == "upright" else FREE_SHARE)
    return matcher.stayed_weight * stayed(aligned, T_scene_scan) - a_meter * moved_m


def stayed(aligned: AlignedPairs, T_scene_scan: Pose) -> Bool[np.ndarray, " p"]:
    """Which pairs fit, by any of their poses, where the instance would be had nothing moved.

    What is round may seem turned. What has another color has changed places with one that looks alike.
    """
    i = aligned.rows[:, 1]
    own = np.stack([o.points.mean(axis=0) for o in aligned.sides[0]])[i]
    R, t = aligned.T_old_new[..., :3, :3], aligned.T_old_new[..., :3, 3]
    there = np.einsum("pkij,pj->pki", R, own) + t
    apart_m = np.linalg.norm(there - apply_pose(T_scene_scan, own)[:, None], axis=-1)
    cosine = (np.einsum("pkij,ij->pk", R, T_scene_scan[:3, :3]) - 1) / 2
    as_turned = cosine > np.cos(np.deg2rad(STAYED_DEG))
    here = ((apart_m < STAYED_M) & as_turned | (apart_m < STAYED_TURNED_M)).any(axis=1)
    return here & (aligned.compared.color > OTHER_COLOR)


def in_place(
    aligned: AlignedPairs, rows: Bool[np.ndarray, " p"], T_scene_scan: Pose
) -> Bool[np.ndarray, " p"]:
    """Which of these pairs lie on each other, or one of them on the other, where nothing moved."""
    here = np.zeros(len(rows), bool)
    for n in np.flatnonzero(rows & (aligned.compared.color > OTHER_COLOR)):
        old, new = (aligned.sides[1 - way][aligned.rows[n, way]].points for way in (0, 1))
        on = lie_on(old, apply_pose(T_scene_scan, new))
        here[n] = on >= IN_PLACE_SHARE and shown_empty(aligned.seen, old, new, T_scene_scan) <= MOST_EMPTY
    return here


def shown_empty(seen: Seen | None, old: Points, new: Points, T_scene_scan: Pose) -> float:
    """Share of a cloud where the other scan saw past its place and found nothing, the larger of both; 0 if unknown."""
    if seen is None:
        return 0.0
    there = apply_pose(T_scene_scan, new), apply_pose(np.linalg.inv(T_scene_scan), old)
    return max(float(space.empty(p, APART_M).mean()) for space, p in zip(seen, there, strict=True))


def lie_on(one: Points, other: Points) -> float:
    """Share of a cloud that lies on another one: of the one of which more does."""
    return max(share_on(one, other), share_on(other, one))


def share_on(cloud: Points, other: Points) -> float:
    """Share of a cloud that lies on another one."""
    near_m = min(IN_PLACE_M, IN_PLACE_RADII * max(rms_radius(cloud), rms_radius(other)))
    return share_near(cloud, other, near_m)


def share_near(cloud: Points, other: Points, near_m: float = IN_PLACE_M) -> float:
    """Share of a cloud with a point of the other one so near."""
    return float(np.isfinite(KDTree(other).query(cloud, distance_upper_bound=near_m)[0]).mean())


def distances_m(
    aligned: AlignedPairs, T_scene_scan: Pose, pairs: Int[np.ndarray, "p 2"]
) -> Float[np.ndarray, " p"]:
    """Between the mean points of the objects and instances of pairs, in the scene's frame."""
    old, new = centers(aligned, T_scene_scan)
    return np.linalg.norm(old[pairs[:, 0]] - new[pairs[:, 1]], axis=-1)


def centers(aligned: AlignedPairs, T_scene_scan: Pose) -> tuple[Points, Points]:
    """Mean points of objects and of instances, in the scene's frame."""
    new, old = (np.stack([o.points.mean(axis=0) for o in side]) for side in aligned.sides)
    return old, apply_pose(T_scene_scan, new)


def with_neighbors(
    prior: Prior, aligned: AlignedPairs, matcher: EvidenceMatcher, motion: MotionModel, T_scene_scan: Pose
) -> AlignedPairs:
    """The same with the pairs that lie beside or on each other, the scan lying at `T_scene_scan`.

    Half of an object looks unlike the whole, so codes and sizes do not propose them where there is much else.
    """
    old, new = centers(aligned, T_scene_scan)
    beside = KDTree(old).sparse_distance_matrix(KDTree(new), BESIDE_M, output_type="coo_matrix")
    near = {(int(k), int(i)) for k, i in zip(beside.row, beside.col, strict=True)}
    listed = set(map(tuple, aligned.rows.tolist()))
    pairs = sorted((near - listed) | on_each_other(aligned, T_scene_scan, near | listed))
    if not pairs:
        return aligned
    a, b = (signatures(side).inv for side in aligned.sides[::-1])
    k, i = np.array(pairs).T
    worth = Proposed(
        pairs=np.array(pairs), likeness=(a[k] * b[i]).sum(axis=1), rank=np.full((len(pairs), 2), np.inf)
    )
    T = np.eye(4)
    T[2, 3] = aligned.height_m
    how = matcher.search, motion
    more = aligned_pairs(prior, aligned.ends, worth, how, T, aligned.seen)
    return together(aligned, more)


def on_each_other(
    aligned: AlignedPairs, T_scene_scan: Pose, known: Set[tuple[int, int]] = frozenset()
) -> set[tuple[int, int]]:
    """The pairs (object, instance), but those `known`, of which much of one lies on the other where nothing moved."""
    new, old = aligned.sides
    placed = (apply_pose(T_scene_scan, o.points) for o in new)
    boxes = [np.array([(p.min(axis=0), p.max(axis=0)) for p in c]) for c in ((o.points for o in old), placed)]
    (low, high), (first, last) = (np.moveaxis(b, 1, 0) for b in boxes)
    meet = ((low[:, None] <= last) & (first <= high[:, None])).all(axis=-1)
    found = set[tuple[int, int]]()
    for k, i in set(map(tuple, np.argwhere(meet).tolist())) - known:
        one, other = old[k].points, apply_pose(T_scene_scan, new[i].points)
        if max(share_near(few(one), other), share_near(few(other), one)) >= LARGE_BESIDE:
            found.add((k, i))
    return found


def few(points: Points, count: int = FEW_POINTS) -> Points:
    """So many of them or somewhat more, at even steps."""
    return points[:: max(1, len(points) // count)]


def together(a: AlignedPairs, b: AlignedPairs) -> AlignedPairs:
    """The pairs of both, of the same objects and instances; none may be in both."""
    order = np.lexsort(np.concatenate([a.rows, b.rows]).T[::-1])

    def both(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.concatenate([np.asarray(x), np.asarray(y)])[order]

    def merged(x: object, y: object) -> dict[str, np.ndarray]:
        return {
            f.name: both(getattr(x, f.name), getattr(y, f.name))
            for f in dataclasses.fields(x)  # pyright: ignore[reportArgumentType]
        }

    return dataclasses.replace(
        a,
        **{name: both(getattr(a, name), getattr(b, name)) for name in BY_PAIR},
        stayed=jax.tree.map(both, a.stayed, b.stayed),
        found=jax.tree.map(both, a.found, b.found),
        compared=Compared(**merged(a.compared, b.compared)),
        metric=MetricEvidence(**merged(a.metric, b.metric)),
    )
