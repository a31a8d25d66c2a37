"""Pairs of objects that may be one: proposed by embeddings and sizes, aligned once, weighed at any common height.

Beyond the paper (`EvidenceMatcher`). What a search finds of a pair does not depend on how high the two scans are taken
to lie: only what a change of height costs does. So pairs are aligned once, whatever heights are then tried.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from more2_jax.config import EvidenceMatcher, MotionModel, SurfaceSearch
from more2_jax.geometry.poses import Pose
from more2_jax.matching.assignment import NEVER, LogOdds
from more2_jax.matching.calibration import Compared, calibrated
from more2_jax.matching.color import color_evidence
from more2_jax.matching.metric_evidence import MetricEvidence, Seen, metric_evidence, seen_in
from more2_jax.matching.pair_evidence import (
    PairEvidence,
    asks_prior,
    off_completed_surfaces,
    off_own_surface,
)
from more2_jax.network.prior import Prior, check_embedding
from more2_jax.registration.pair_batch import PairBatch, local_batch, paired_rows, take_pairs
from more2_jax.registration.pose_costs import LIFTED
from more2_jax.registration.search import AlignableObject, FoundPoses, alignable, search_poses
from more2_jax.types import LocalBatch, ObservedObject

TOP = 0.99  # share of a cloud's points below its top


@dataclass(frozen=True, kw_only=True)
class AlignedPairs:
    """The pairs of objects (n) and instances (m) that were aligned, and all that is known of them; p pairs."""

    among: Bool[np.ndarray, "n m"]  # which pairs these are; they are listed row by row
    pairs: PairBatch  # instances onto objects, with the poses found
    objects: tuple[AlignableObject, AlignableObject]  # instances and objects of the pairs, (p, …)
    found: FoundPoses  # (p, k), local frames
    T_old_new: Float[np.ndarray, "p k 4 4"]  # those poses between the clouds' frames, float64
    compared: Compared
    top_gap_m: Float[np.ndarray, " p"]  # by how much the object's top is higher than the instance's
    off: Float[np.ndarray, "p k 2"]  # off the completed surfaces; 0 where that is not asked
    off_own: Float[np.ndarray, " p"]
    metric: MetricEvidence
    seen: Seen | None = None  # what both scans saw; None where that is no evidence (any orientation)
    height_m: float = 0.0  # upright: that the scan was taken to lie at

    def take(self, chosen: Sequence[tuple[int, int]]) -> PairBatch:
        """Some pairs (object, instance) as registration takes them: with the poses found, and as prepared."""
        whole = dataclasses.replace(self.pairs, candidates=self.found.poses, prepared=self.objects)
        return take_pairs(whole, [self.row_of(k, i) for k, i in chosen])

    def row_of(self, object_row: int, instance_row: int) -> int:
        """Where a pair is listed."""
        return int(self.among.ravel()[: object_row * self.among.shape[1] + instance_row].sum())


def align_candidates(
    prior: Prior,
    old: Sequence[ObservedObject],
    new: Sequence[ObservedObject],
    matcher: EvidenceMatcher,
    motion: MotionModel,
    T_scene_scan: Pose | None = None,
    seen: Seen | None = None,
) -> AlignedPairs:
    """Aligns the likeliest pairs of `old` (scene's frame) and `new` (scan's frame).

    `T_scene_scan`: how the scan is taken to lie, for what did not move; by default in the scene's frame. `seen`: what
    both scans show, upright; by default objects and instances alone. Raises ValueError as `check_asked` does.
    """
    check_asked(prior, (*old, *new), matcher, motion)
    known = compared(old, new)
    among = proposed(proposal_of(known, matcher), matcher.candidates)
    rows = np.argwhere(among)[:, ::-1]
    sides, ready = prepared((new, old), matcher.search)
    pairs = paired_rows(*sides, rows, np.eye(4) if T_scene_scan is None else T_scene_scan)
    objects = taken(ready[0], rows[:, 0]), taken(ready[1], rows[:, 1])
    found = search_poses(*objects, pairs.stayed, matcher.search, motion)
    found, off, own = told_by_prior(prior, ready, rows, found, matcher.search, motion)
    T_old_new = pairs.to_world(found.poses)
    seen = (seen or seen_in(old, new)) if motion == "upright" else None
    metric = metric_evidence((new, old), sides, ready, rows, T_old_new, seen)
    return AlignedPairs(
        among=among,
        pairs=pairs,
        objects=objects,
        found=found,
        T_old_new=T_old_new,
        seen=seen,
        metric=metric,
        compared=Compared(**{k: v[among] for k, v in vars(known).items()}),
        top_gap_m=(heights(old)[1][:, None] - heights(new)[1])[among],
        off=off,
        off_own=own,
        height_m=0.0 if T_scene_scan is None else float(T_scene_scan[2, 3]),
    )


def told_by_prior(
    prior: Prior,
    ready: Sequence[AlignableObject],
    rows: Int[np.ndarray, "p 2"],
    found: FoundPoses,
    search: SurfaceSearch,
    motion: MotionModel,
) -> tuple[FoundPoses, Float[np.ndarray, "p k 2"], Float[np.ndarray, " p"]]:
    """Where the prior is asked: poses in its order, how far both clouds lie off completed surfaces, and off their own.

    Elsewhere the poses as they are, and zeros.
    """
    if not asks_prior(search, motion):
        return found, np.zeros((*found.cost.shape, 2)), np.zeros(len(found.cost))
    sides = list(zip(ready, rows.T, strict=True))
    source, target = (taken(x, at) for x, at in sides)
    found, off = off_completed_surfaces(prior, source, target, found, search)
    return found, off, np.max([off_own_surface(prior, x)[at] for x, at in sides], axis=0)


def prepared(
    sides: tuple[Sequence[ObservedObject], Sequence[ObservedObject]], search: SurfaceSearch
) -> tuple[tuple[LocalBatch, LocalBatch], tuple[AlignableObject, AlignableObject]]:
    """Both sides as batches, and their objects ready to be aligned, without the batches' fillers."""
    first, second = (local_batch(side) for side in sides)
    ready = (
        alignable(b.take(np.arange(len(s))), search) for b, s in zip((first, second), sides, strict=True)
    )
    return (first, second), tuple(ready)  # pyright: ignore[reportReturnType]


def taken(objects: AlignableObject, rows: Int[np.ndarray, " p"]) -> AlignableObject:
    """The objects in `rows`, in that order."""
    return jax.tree.map(lambda x: x[rows], objects)


def check_asked(
    prior: Prior, objects: Sequence[ObservedObject], matcher: EvidenceMatcher, motion: MotionModel
) -> None:
    """Raises ValueError where the prior is asked (any orientation) about the records of another encoder."""
    if asks_prior(matcher.search, motion):
        for o in objects:
            check_embedding(prior, o.embedding, "match")


def odds_of(
    aligned: AlignedPairs, search: SurfaceSearch, motion: MotionModel, height_m: float = 0.0
) -> LogOdds:
    """Log odds of every pair to be one object, upright with `height_m` added to the new scan's heights.

    `NEVER` for pairs that were not aligned.
    """
    evidence = evidence_at(aligned, search, motion, height_m)
    odds = np.full(aligned.among.shape, NEVER)
    odds[aligned.among] = calibrated(evidence, compared_at(aligned, height_m), search, motion)
    return odds


def compared_at(aligned: AlignedPairs, height_m: float) -> Compared:
    """What is known of the pairs without aligning them, at a common height."""
    return dataclasses.replace(aligned.compared, top_m=np.abs(aligned.top_gap_m - height_m))


def evidence_at(
    aligned: AlignedPairs, search: SurfaceSearch, motion: MotionModel, height_m: float = 0.0
) -> PairEvidence:
    """What the best pose of every pair says, upright at a common height."""
    found, radius = aligned.found, np.asarray(aligned.objects[1].radius)
    z = np.asarray(found.poses.translation()[..., 2])
    stayed = np.asarray(aligned.pairs.stayed.translation()[..., 2])[:, None]
    lift = np.abs(z - stayed - (height_m - aligned.height_m))
    best = np.zeros(len(z), int)  # as they are ordered
    if motion == "upright":
        cost = np.asarray(found.cost) - height_penalty(np.abs(z - stayed), radius, search)
        best = np.argmin(cost + height_penalty(lift, radius, search), axis=1)
    at = np.arange(len(best)), best
    return PairEvidence(
        pose=best,
        apart_source=aligned.metric.apart[at][:, 0],
        apart_target=aligned.metric.apart[at][:, 1],
        contradicted=aligned.metric.contradicted[at],
        lift_m=lift[at],
        radius_m=radius,
        off_source=aligned.off[at][:, 0],
        off_target=aligned.off[at][:, 1],
        off_own=aligned.off_own,
    )


def height_penalty(
    lift_m: Float[np.ndarray, "p k"], radius_m: Float[np.ndarray, " p"], search: SurfaceSearch
) -> Float[np.ndarray, "p k"]:
    """`pose_costs.height_cost` on the host."""
    return search.lift_weight * np.minimum(lift_m / (LIFTED * radius_m[:, None]), 1.0)


def proposal_of(known: Compared, matcher: EvidenceMatcher) -> LogOdds:
    """By what the embeddings propose pairs: likeness, less a difference in size."""
    return known.likeness - matcher.size_weight * known.size


def heights(side: Sequence[ObservedObject]) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Heights of every cloud's lowest and highest points, meters."""
    low, high = np.array([np.quantile(o.points[:, 2], (1 - TOP, TOP)) for o in side]).T
    return low, high


def compared(old: Sequence[ObservedObject], new: Sequence[ObservedObject]) -> Compared:
    """Every object with every instance, by size, code, height and color."""
    a, b = (np.array([float(o.embedding.scale) for o in side]) for side in (old, new))
    x, y = (np.stack([np.asarray(o.embedding.inv, np.float64) for o in side]) for side in (old, new))
    x, y = (v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-30) for v in (x, y))
    (_, top), (_, other) = heights(old), heights(new)
    return Compared(
        size=np.abs(np.log(a[:, None] / b)),
        likeness=x @ y.T,
        top_m=np.abs(top[:, None] - other),
        color=color_evidence([o.color for o in old], [o.color for o in new]),
    )


def proposed(score: LogOdds, count: int) -> Bool[np.ndarray, "n m"]:
    """True for the best `count` of every row and of every column; all where `count` is 0."""
    if not count:
        return np.ones(score.shape, bool)
    rows = np.argsort(np.argsort(-score, axis=1, kind="stable"), axis=1) < count
    columns = np.argsort(np.argsort(-score, axis=0, kind="stable"), axis=0) < count
    return rows | columns
