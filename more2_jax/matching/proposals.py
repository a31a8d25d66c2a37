"""Which pairs of objects are worth aligning: the likeliest partners of each by code, size and, in a building, place.

Beyond the paper (`EvidenceMatcher`). Scores are made some rows at a time and only the best are kept: of n objects and m
instances there is never an array of n × m.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from more2_jax.config import EvidenceMatcher, MotionModel
from more2_jax.geometry.poses import Points, Pose, apply_pose
from more2_jax.matching.assignment import FARTHEST_M
from more2_jax.types import ObservedObject

EXTENT_WEIGHT = 0.5  # of what both differ by in log extents, docs/developing/notebook/proposals.md
THIN_M = 0.02  # added to extents: noise makes a board as thick, and no log of nothing is asked
HEIGHTS = (2.0, 98.0)  # percentiles between which a thing's height lies: masks hold some stray points
ROWS_AT_ONCE = 512  # objects that are scored against all instances at a time
# Where a scan's objects lie farther apart than this it is more than a room, and places tell much:
ROOM_M = 15.0
NEAR_M = FARTHEST_M  # partners are then sought first within what an object is expected to move at most,
ANYWHERE = 4  # and one in so many of them anywhere: some things are carried off, and frames may differ
FAR = 1e3  # taken off the score of what is not near: more than any two scores differ by


@dataclass(frozen=True, kw_only=True)
class Signatures:
    """What the objects of one scan are proposed by."""

    inv: Float[np.ndarray, "n c"]  # F_inv, of unit length
    scale: Float[np.ndarray, " n"]  # F_s, meters
    center: Points  # mean points, in a frame that both scans share, as far as is known; meters
    extent: Float[np.ndarray, "n 3"] | None = None  # log of meters, as `extent_of`; None: not compared


@dataclass(frozen=True, kw_only=True)
class Proposed:
    """Pairs that are worth aligning."""

    pairs: Int[np.ndarray, "p 2"]  # (object, instance), by objects, then by instances
    likeness: Float[np.ndarray, " p"]  # cosine of the F_inv
    # How many instances are likelier partners of the object, and objects of the instance; infinite where too many.
    rank: Float[np.ndarray, "p 2"]

    def among(self, pairs: Collection[tuple[int, int]]) -> Proposed:
        """Those of the pairs that are among some, in their order."""
        return self.rows(np.array([(k, i) in pairs for k, i in self.pairs.tolist()], bool))

    def rows(self, at: slice | Bool[np.ndarray, " p"]) -> Proposed:
        """Some of the pairs, in their order."""
        return Proposed(pairs=self.pairs[at], likeness=self.likeness[at], rank=self.rank[at])


def signatures(
    side: Sequence[ObservedObject], place: Pose | None = None, motion: MotionModel | None = None
) -> Signatures:
    """Those of one scan's objects, with extents where `motion` says how objects may turn.

    `place`: how the scan lies in the frame that both share; by default as given.
    """
    each = [
        (
            np.asarray(o.embedding.inv, np.float64),
            float(o.embedding.scale),
            o.points.mean(axis=0),
            None if motion is None else extent_of(o.points, motion),
        )
        for o in side  # once: halves of masks are made when they are asked for
    ]
    inv, scale, center, extent = (np.array(part) for part in zip(*each, strict=True))
    return Signatures(
        inv=inv / np.maximum(np.linalg.norm(inv, axis=1, keepdims=True), 1e-30),
        scale=scale,
        center=center if place is None else apply_pose(place, center),
        extent=None if motion is None else extent,
    )


def extent_of(points: Points, motion: MotionModel) -> Float[np.ndarray, "3"]:
    """How far a thing reaches, log of meters, however it is turned: upright its height, and standard deviations along
    the axes of its outline from above; else those along its own three axes, the least first.
    """
    centered = points - points.mean(axis=0)
    if motion == "upright":
        low, high = np.percentile(centered[:, 2], HEIGHTS)
        spread = np.linalg.eigvalsh(centered[:, :2].T @ centered[:, :2] / len(points))
        return np.log(THIN_M + np.array([high - low, *np.sqrt(np.maximum(spread, 0.0))]))
    spread = np.linalg.eigvalsh(centered.T @ centered / len(points))
    return np.log(THIN_M + np.sqrt(np.maximum(spread, 0.0)))


def proposed(
    old: Sequence[ObservedObject],
    new: Sequence[ObservedObject],
    matcher: EvidenceMatcher,
    place: Pose | None = None,
    *,
    motion: MotionModel,
) -> Proposed:
    """The pairs to align: `matcher.candidates` partners of every object and of every instance; 0: all pairs.

    In a building they are sought near the object first, as `place` (T_scene_scan) has it, and a few anywhere. `motion`
    says how objects may turn, and so which extents stay.
    """
    a, b, count = signatures(old, None, motion), signatures(new, place, motion), matcher.candidates
    if not count or not is_building(a, b):
        return likeliest(a, b, count, matcher.size_weight)
    near = likeliest(a, b, count, matcher.size_weight, NEAR_M)
    return union(near, likeliest(a, b, -(-count // ANYWHERE), matcher.size_weight), len(new))


def is_building(*sides: Signatures) -> bool:
    """Whether the objects of a scan lie so far apart that they do not stand in one room."""
    return max(float(np.ptp(s.center, axis=0).max()) for s in sides) > ROOM_M


def likeliest(
    a: Signatures, b: Signatures, count: int, size_weight: float, near_m: float | None = None
) -> Proposed:
    """The `count` likeliest partners of every object and every instance, those within `near_m` before others; 0: all.

    Likely is what looks alike, less a difference in size: F_inv, F_s, extents if known. Of equals the first is taken.
    """
    n, m = len(a.scale), len(b.scale)
    of_object, of_instance = count or m, count or n
    best = np.zeros((3, 0, m))  # of every instance, best first: score, likeness, object
    found = []
    for start in range(0, n, ROWS_AT_ONCE):
        rows = np.arange(start, min(start + ROWS_AT_ONCE, n))
        likeness = a.inv[rows] @ b.inv.T
        score = likeness - size_weight * np.abs(np.log(a.scale[rows, None] / b.scale))
        if a.extent is not None and b.extent is not None:
            score -= EXTENT_WEIGHT * np.abs(a.extent[rows, None] - b.extent).sum(axis=-1)
        if near_m is not None:
            apart = np.linalg.norm(a.center[rows, None] - b.center, axis=-1)
            score = np.where(apart <= near_m, score, score - FAR)
        order = np.argsort(-score, axis=1, kind="stable")[:, :of_object]
        ranks = np.broadcast_to(np.arange(order.shape[1]), order.shape)
        likely = np.take_along_axis(likeness, order, axis=1)
        every = np.broadcast_to(rows[:, None], order.shape)
        found.append(np.stack([every.ravel(), order.ravel(), likely.ravel(), ranks.ravel()]))
        block = np.stack([score, likeness, np.broadcast_to(rows[:, None].astype(float), score.shape)])
        both = np.concatenate([best, block], axis=1)
        first = np.argsort(-both[0], axis=0, kind="stable")[:of_instance]
        best = np.take_along_axis(both, first[None], axis=1)
    ranks, columns = np.indices(best.shape[1:])
    by_instance = np.stack([best[2].ravel(), columns.ravel(), best[1].ravel(), ranks.ravel()])
    return listed(np.concatenate(found, axis=1), by_instance, m)


def listed(
    by_object: Float[np.ndarray, "4 p"], by_instance: Float[np.ndarray, "4 q"], instances: int
) -> Proposed:
    """One list of both (object, instance, likeness, rank by row)."""
    every = np.concatenate([by_object, by_instance], axis=1)
    key = every[0].astype(int) * instances + every[1].astype(int)
    pair, first, back = np.unique(key, return_index=True, return_inverse=True)
    rank = np.full((len(pair), 2), np.inf)
    split = by_object.shape[1]
    rank[back[:split], 0], rank[back[split:], 1] = by_object[3], by_instance[3]
    pairs = np.stack(np.divmod(pair, instances), axis=1)
    return Proposed(pairs=pairs, likeness=every[2, first], rank=rank)


def union(a: Proposed, b: Proposed, instances: int) -> Proposed:
    """Pairs of either, each once, with the ranks of the first that has it."""
    both = {
        f.name: np.concatenate([getattr(a, f.name), getattr(b, f.name)]) for f in dataclasses.fields(Proposed)
    }
    _, first = np.unique(both["pairs"] @ [instances, 1], return_index=True)
    return Proposed(**{name: value[first] for name, value in both.items()})
