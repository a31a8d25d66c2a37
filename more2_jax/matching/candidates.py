"""Pairs of objects that may be one: proposed by embeddings and sizes, aligned once, weighed at any common height.

Beyond the paper (`EvidenceMatcher`). What a search finds of a pair does not depend on how high the two scans are taken
to lie: only what a change of height costs does. So pairs are aligned once, whatever heights are then tried.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jaxlie
import numpy as np
from jaxtyping import Float, Int

from more2_jax.config import EvidenceMatcher, MotionModel, SurfaceSearch
from more2_jax.geometry.poses import Pose, local_poses, on_host, world_poses
from more2_jax.matching.assignment import LogOdds, listed_at
from more2_jax.matching.calibration import Compared, calibrated
from more2_jax.matching.color import color_evidence
from more2_jax.matching.metric_evidence import (
    APART_M,
    MetricEvidence,
    Seen,
    apart_within,
    metric_evidence,
    samples_of,
    seen_in,
)
from more2_jax.matching.pair_evidence import (
    PairEvidence,
    asks_prior,
    off_completed_surfaces,
    off_own_surface,
)
from more2_jax.matching.proposals import Proposed, proposed
from more2_jax.network.prior import Prior, check_embedding
from more2_jax.registration.pair_batch import PairBatch, host_origin, local_batch
from more2_jax.registration.pose_costs import LIFTED
from more2_jax.registration.search import (
    AlignableObject,
    FoundPoses,
    alignable,
    rows_taken,
    search_poses,
    searched,
)
from more2_jax.types import ObservedObject

TOP = 0.99  # share of a cloud's points below its top
# Longest edge, meters, of what people put on furniture and take off it: surely, and hardly.
PORTABLE_M = 0.45, 0.7
OBJECTS_AT_ONCE = 64  # padded and prepared at a time


@dataclass(frozen=True, kw_only=True)
class ReadySide:
    """What one scan brings to be aligned, or the scene so far; k clouds."""

    objects: Sequence[ObservedObject]
    # What sensors saw only where a search asks. Of many objects only what a comparison needs.
    ready: AlignableObject
    origins: Float[np.ndarray, "k 3"]  # of their local frames


@dataclass(frozen=True, kw_only=True)
class AlignedPairs:
    """The pairs of objects (n) and instances (m) that were aligned, and all that is known of them; p pairs.

    What was prepared is held once an object, whatever number of pairs it is part of.
    """

    rows: Int[np.ndarray, "p 2"]  # (object, instance), by objects, then by instances
    ends: tuple[ReadySide, ReadySide]  # instances (m) and objects (n)
    search: SurfaceSearch  # that they were prepared for
    stayed: jaxlie.SE3  # (p,): "it did not move", an instance's local frame to the object's
    found: FoundPoses  # (p, k), local frames: instances onto objects
    T_old_new: Float[np.ndarray, "p k 4 4"]  # those poses between the clouds' frames, float64
    compared: Compared
    top_gap_m: Float[np.ndarray, " p"]  # by how much the object's top is higher than the instance's
    off: Float[np.ndarray, "p k 2"]  # off the completed surfaces; 0 where that is not asked
    off_own: Float[np.ndarray, " p"]
    metric: MetricEvidence
    seen: Seen | None = None  # what both scans saw; None where that is no evidence (any orientation)
    height_m: float = 0.0  # upright: that the scan was taken to lie at

    @property
    def sides(self) -> tuple[Sequence[ObservedObject], Sequence[ObservedObject]]:
        """The instances (m) and the objects (n)."""
        return self.ends[0].objects, self.ends[1].objects

    @property
    def ready(self) -> tuple[AlignableObject, AlignableObject]:
        """The same as they were prepared."""
        return self.ends[0].ready, self.ends[1].ready

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of objects and of instances."""
        return len(self.sides[1]), len(self.sides[0])

    def take(
        self,
        chosen: Sequence[tuple[int, int]],
        sides: tuple[Sequence[ObservedObject], Sequence[ObservedObject]] | None = None,
    ) -> PairBatch:
        """Some pairs (object, instance) as registration takes them: with the poses found, and as prepared.

        `sides`: the same instances and objects, by which more is known of what sensors saw.
        """
        at = self.rows_of(chosen)
        ends = self.rows[at, 1], self.rows[at, 0]
        source, target = (
            local_batch([side[k] for k in end], len(end), side)
            for side, end in zip(sides or self.sides, ends, strict=True)
        )
        sights = source.sight, target.sight
        ready = rows_taken(self.ready, np.stack(ends, axis=1))
        if self.ready[0].whole is None:
            blind = (dataclasses.replace(side, sight=None) for side in (source, target))
            ready = tuple(alignable(side, self.search) for side in blind)
        stayed, poses = jax.tree.map(lambda x: x[at], (self.stayed, self.found.poses))
        return PairBatch(
            source=source,
            target=target,
            stayed=stayed,
            candidates=poses,
            prepared=tuple(  # pyright: ignore[reportArgumentType]
                dataclasses.replace(r, sight=s) for r, s in zip(ready, sights, strict=True)
            ),
        )

    def rows_of(self, chosen: Sequence[tuple[int, int]]) -> Int[np.ndarray, " c"]:
        """Where pairs (object, instance) are listed."""
        return listed_at(self.rows, np.reshape(np.asarray(chosen, int), (-1, 2)), self.shape[1])


def align_candidates(
    prior: Prior,
    old: Sequence[ObservedObject],
    new: Sequence[ObservedObject],
    matcher: EvidenceMatcher,
    motion: MotionModel,
    T_scene_scan: Pose | None = None,
    seen: Seen | None = None,
    place: Pose | None = None,
) -> AlignedPairs:
    """Aligns the likeliest pairs of `old` (scene's frame) and `new` (scan's frame).

    `T_scene_scan`: how the scan is taken to lie, for what did not move; by default in the scene's frame. `seen`: what
    both scans show, upright; by default objects and instances alone. `place`: the same motion as far as it says where
    partners are sought (`proposals`), by default `T_scene_scan`. Raises ValueError as `check_asked` does.
    """
    T = np.eye(4) if T_scene_scan is None else T_scene_scan
    worth = proposed(old, new, matcher, T if place is None else place, motion=motion)
    return align_proposed(prior, (old, new), worth, matcher, motion, T, seen)


def align_proposed(
    prior: Prior,
    clouds: tuple[Sequence[ObservedObject], Sequence[ObservedObject]],
    worth: Proposed,
    matcher: EvidenceMatcher,
    motion: MotionModel,
    T_scene_scan: Pose,
    seen: Seen | None = None,
) -> AlignedPairs:
    """Aligns the pairs in `worth` of `clouds`: objects (scene's frame) and instances (scan's frame), one each at least.

    `T_scene_scan`, `seen` and errors as in `align_candidates`.
    """
    old, new = clouds
    check_asked(prior, (*old, *new), matcher, motion)
    few = max(len(old), len(new)) <= OBJECTS_AT_ONCE
    instances, objects = (prepared(x, matcher.search, motion, few) for x in (new, old))
    return aligned_pairs(
        prior,
        (instances, objects),
        worth,
        (matcher.search, motion),
        T_scene_scan,
        (seen or seen_in(old, new)) if motion == "upright" else None,
    )


def aligned_pairs(
    prior: Prior,
    sides: tuple[ReadySide, ReadySide],
    worth: Proposed,
    how: tuple[SurfaceSearch, MotionModel],
    T_scene_scan: Pose,
    seen: Seen | None,
) -> AlignedPairs:
    """The proposed pairs of instances and objects (`sides`)."""
    rows, (search, motion), (new, old) = worth.pairs[:, ::-1], how, sides
    ready, origins = (new.ready, old.ready), (old.origins[rows[:, 1]], new.origins[rows[:, 0]])
    stayed = local_poses(np.broadcast_to(T_scene_scan, (len(rows), 4, 4)), *origins)
    found = search_poses(*ready, stayed, search, motion, rows)
    found, off, own = told_by_prior(prior, ready, rows, found, search, motion)
    T_old_new = world_poses(found.poses, origins[0][:, None], origins[1][:, None])
    return AlignedPairs(
        ends=sides,
        search=search,
        stayed=stayed,
        found=found,
        T_old_new=T_old_new,
        off=off,
        off_own=own,
        height_m=float(T_scene_scan[2, 3]),
        **known_of(worth, sides, T_old_new, seen),
    )


def known_of(
    worth: Proposed,
    sides: tuple[ReadySide, ReadySide],
    T_old_new: Float[np.ndarray, "p k 4 4"],
    seen: Seen | None,
) -> dict[str, Any]:
    """What clouds and codes say of the proposed pairs of instances and objects."""
    new, old = (side.objects for side in sides)
    samples = samples_of(sides[0].ready, sides[0].origins), samples_of(sides[1].ready, sides[1].origins)
    k, i = worth.pairs.T
    return {
        "rows": worth.pairs,
        "metric": metric_evidence((new, old), samples, worth.pairs[:, ::-1], T_old_new, seen),
        "compared": compared(old, new, worth),
        "top_gap_m": heights(old)[1][k] - heights(new)[1][i],
        "seen": seen,
    }


def measured_among(aligned: AlignedPairs, noise_m: float) -> AlignedPairs:
    """The same, compared as far as noise puts surfaces of two scans apart; at usual noise as it is."""
    apart_m = apart_within(noise_m)
    return aligned if apart_m == APART_M else measured_within(aligned, apart_m)


def measured_within(aligned: AlignedPairs, apart_m: float) -> AlignedPairs:
    """The same, distances between clouds and what lies around them truncated at `apart_m` (`metric_evidence`)."""
    sides, rows = aligned.ends, aligned.rows[:, ::-1]
    samples = samples_of(sides[0].ready, sides[0].origins), samples_of(sides[1].ready, sides[1].origins)
    metric = metric_evidence(aligned.sides, samples, rows, aligned.T_old_new, aligned.seen, apart_m)
    return dataclasses.replace(aligned, metric=metric)


def told_by_prior(
    prior: Prior,
    ready: tuple[AlignableObject, AlignableObject],
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
    found, off = off_completed_surfaces(prior, ready, rows, found, search)
    own = [off_own_surface(prior, x)[at] for x, at in zip(ready, rows.T, strict=True)]
    return found, off, np.max(own, axis=0)


def prepared(
    side: Sequence[ObservedObject], search: SurfaceSearch, motion: MotionModel, keep: bool
) -> ReadySide:
    """The objects of one scan ready to be aligned.

    `OBJECTS_AT_ONCE` are padded at a time; without what sensors saw, which only a search with a `free_weight` reads.
    `keep`: with all that registration reads as well, 0.3 MB an object; else, in any orientation, half of it.
    """
    ready, origins = list[AlignableObject](), list[np.ndarray]()
    for start in range(0, len(side), OBJECTS_AT_ONCE):
        some = side[start : start + OBJECTS_AT_ONCE]
        batch = local_batch(some, len(some), side)
        origins.append(host_origin(batch))
        every = alignable(batch if search.free_weight else dataclasses.replace(batch, sight=None), search)
        if not keep:
            every = dataclasses.replace(every, whole=None) if asks_prior(search, motion) else searched(every)
        ready.append(every)
    every = jax.tree.map(lambda *x: np.concatenate(x), *ready)
    return ReadySide(objects=side, ready=every, origins=np.concatenate(origins))


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
    """Log odds of every aligned pair to be one object, upright with `height_m` added to the new scan's heights."""
    evidence = evidence_at(aligned, search, motion, height_m)
    value = calibrated(evidence, compared_at(aligned, height_m), search, motion)
    return LogOdds(pairs=aligned.rows, value=value, shape=aligned.shape)


def compared_at(aligned: AlignedPairs, height_m: float) -> Compared:
    """What is known of the pairs without aligning them, at a common height."""
    return dataclasses.replace(aligned.compared, top_m=np.abs(aligned.top_gap_m - height_m))


def evidence_at(
    aligned: AlignedPairs, search: SurfaceSearch, motion: MotionModel, height_m: float = 0.0
) -> PairEvidence:
    """What the best pose of every pair says, upright at a common height."""
    found, radius = aligned.found, np.asarray(aligned.ready[1].radius)[aligned.rows[:, 0]]
    z, stayed = on_host(found.poses)[..., 6], on_host(aligned.stayed)[:, None, 6]
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


def heights(side: Sequence[ObservedObject]) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Heights of every cloud's lowest and highest points, meters."""
    low, high = np.array([np.quantile(o.points[:, 2], (1 - TOP, TOP)) for o in side]).T
    return low, high


def compared(old: Sequence[ObservedObject], new: Sequence[ObservedObject], worth: Proposed) -> Compared:
    """The proposed pairs by size, code, height and color."""
    k, i = worth.pairs.T
    a, b = (np.array([float(o.embedding.scale) for o in side]) for side in (old, new))
    (_, top), (_, other) = heights(old), heights(new)
    return Compared(
        size=np.abs(np.log(a[k] / b[i])),
        likeness=worth.likeness,
        top_m=np.abs(top[k] - other[i]),
        color=color_evidence([o.color for o in old], [o.color for o in new], worth.pairs),
        portable=portable(np.maximum(longest(old)[k], longest(new)[i])),
    )


def longest(side: Sequence[ObservedObject]) -> Float[np.ndarray, " k"]:
    """Longest edge of every cloud's box, meters."""
    return np.array([np.ptp(o.points, axis=0).max() for o in side])


def portable(longest_m: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """How likely things of this size are put on furniture and off it, 0 to 1: their height then says little."""
    surely, hardly = PORTABLE_M
    return np.clip((hardly - longest_m) / (hardly - surely), 0.0, 1.0)
