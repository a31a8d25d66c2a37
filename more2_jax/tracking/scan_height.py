"""The common height of two scans of upright things: by floors, tops and bottoms, and by what then fits."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from more2_jax.config import EvidenceMatcher
from more2_jax.geometry.floor import floor_height
from more2_jax.geometry.poses import vertical_shift
from more2_jax.matching.assignment import LogOdds, assign
from more2_jax.matching.candidates import (
    AlignedPairs,
    align_candidates,
    evidence_at,
    heights,
    odds_of,
)
from more2_jax.matching.metric_evidence import seen_in
from more2_jax.matching.proposals import likeliest, signatures
from more2_jax.network.prior import Prior
from more2_jax.tracking.rooms import Rooms
from more2_jax.types import ObservedObject

SPREAD_M = 0.015  # of the votes for a height
VOTERS = 32  # partners of an object that vote: the next has 2⁻³² of the first one's weight
HEIGHTS = 2048  # at which votes are counted; of rooms with 32 objects and fewer all
VOTES_AT_ONCE = 1 << 22  # differences of heights in memory: 32 MB
AS_GOOD_VOTES = 0.8  # share of the most votes at which heights that agree are not doubted
CLEARLY = 3.0  # of log odds over a scene: what a change of height must explain beyond none at all
LEAST_M = 0.005  # a smaller lift is none
FLOORS_APART_M = (
    0.05  # floors at other heights than these are seen apart: the lift between them is then expected
)
OUT_OF_REACH_M = 0.1  # an alignment begun at another height finds its own from nearer than this
BEGUN_APART_M = 0.05  # and two lifts nearer than this are settled from one alignment, begun at the first


@dataclass(frozen=True, kw_only=True)
class Weighed:
    """Aligned pairs, and how likely each is one object at the height that explains the scans best."""

    height_m: float  # to be added to the new scan's heights
    aligned: AlignedPairs
    odds: LogOdds

    @cached_property
    def assigned(self) -> Int[np.ndarray, "q 2"]:
        """The likeliest assignment, wherever things moved."""
        return assign(self.odds)

    @property
    def explained(self) -> float:
        """Log odds of the likeliest assignment against no pair at all."""
        return float(self.odds.value[self.odds.rows_of(self.assigned)].sum())

    @property
    def matched(self) -> int:
        """How many pairs that assignment has."""
        return len(self.assigned)

    def overrules(self, expected: Weighed) -> bool:
        """Whether this height is believed against the one expected: it explains clearly more, and loses no pair."""
        return self.explained > expected.explained + CLEARLY and self.matched >= expected.matched


def common_height(
    prior: Prior,
    old: Sequence[ObservedObject],
    new: Sequence[ObservedObject],
    matcher: EvidenceMatcher,
    rooms: Rooms,
) -> Weighed:
    """The lift of a new scan that explains both scans best, and how pairs then fit; upright.

    Expected is no lift, or the one between floors that lie clearly apart, if no pair is lost by it. Another (by most
    tops and bottoms of likely pairs, or by the floors) is taken where it overrules that.
    """
    votes, weights = height_votes(old, new, matcher)
    floors = [floor_height(p) for p in (rooms.scene, rooms.scan)]
    between_m = 0.0 if floors[0] is None or floors[1] is None else floors[0] - floors[1]
    lifts_m = [between_m, *([best_vote(votes, weights)] if doubtful(votes, weights) else [])]
    seen = seen_in(old, new, rooms.scene, rooms.scan)

    def aligned_at(height_m: float) -> AlignedPairs:
        return align_candidates(prior, old, new, matcher, "upright", vertical_shift(height_m), seen)

    aligned = aligned_at(0.0)
    none = weighed_at(aligned, matcher, 0.0)
    begun, lifted = {0.0: aligned}, dict[float, Weighed]()
    for m in (m for m in lifts_m if abs(m) > LEAST_M):
        begins_m = begins_at(m, begun)
        if begins_m not in begun:
            begun[begins_m] = aligned_at(begins_m)
        lifted[m] = settled_height(begun[begins_m], matcher, m)
    expected = none
    if abs(between_m) > FLOORS_APART_M and lifted[between_m].matched >= none.matched:
        expected = lifted[between_m]
    others = [x for x in (none, *lifted.values()) if x.overrules(expected)]
    return max(others, key=lambda x: x.explained, default=expected)


def begins_at(height_m: float, begun: Iterable[float]) -> float:
    """At which height the alignment begins that is to find this one: one that has `begun`, if that is near enough."""
    if abs(height_m) <= OUT_OF_REACH_M:
        return 0.0
    return next((m for m in begun if m and abs(height_m - m) < BEGUN_APART_M), height_m)


def weighed_at(aligned: AlignedPairs, matcher: EvidenceMatcher, height_m: float) -> Weighed:
    """The aligned pairs at one height."""
    odds = odds_of(aligned, matcher.search, "upright", height_m)
    return Weighed(height_m=height_m, aligned=aligned, odds=odds)


def settled_height(aligned: AlignedPairs, matcher: EvidenceMatcher, height_m: float) -> Weighed:
    """A height corrected by the pairs that it makes fit, where that explains more."""
    first = weighed_at(aligned, matcher, height_m)
    rows = first.odds.rows_of(first.assigned)
    if len(rows) < 2:
        return first
    best = evidence_at(aligned, matcher.search, "upright", height_m).pose[rows]
    corrected_m = float(np.median(aligned.T_old_new[rows, best, 2, 3]))
    if not LEAST_M < abs(corrected_m - height_m) < OUT_OF_REACH_M:
        return first
    again = weighed_at(aligned, matcher, corrected_m)
    return again if again.explained > first.explained else first


def height_votes(
    old: Sequence[ObservedObject], new: Sequence[ObservedObject], matcher: EvidenceMatcher
) -> tuple[Float[np.ndarray, " v"], Float[np.ndarray, " v"]]:
    """Differences of the bottoms and of the tops of likely pairs, meters, and their weights.

    A partner has half the weight of one that is likelier; from the `VOTERS`-th on none.
    """
    likely = likeliest(signatures(old), signatures(new), VOTERS, matcher.size_weight)
    k, i = likely.pairs.T
    weight = 0.5 ** likely.rank[:, 1] + 0.5 ** likely.rank[:, 0]
    differences = [a[k] - b[i] for a, b in zip(heights(old), heights(new), strict=True)]
    return np.concatenate(differences), np.tile(weight, len(differences))


def few(votes: Float[np.ndarray, " v"]) -> Float[np.ndarray, " k"]:
    """Some of the heights that have votes, `HEIGHTS` at most: a building has more pairs than heights."""
    return votes[:: max(1, -(-len(votes) // HEIGHTS))]


def support(
    at: Float[np.ndarray, " k"], votes: Float[np.ndarray, " v"], weights: Float[np.ndarray, " v"]
) -> Float[np.ndarray, " k"]:
    """Votes for every height, each spread by `SPREAD_M`; some heights at a time."""
    step = max(1, VOTES_AT_ONCE // len(votes))
    blocks = [at[start : start + step] for start in range(0, len(at), step)]
    return np.concatenate([np.exp(-0.5 * ((x[:, None] - votes) / SPREAD_M) ** 2) @ weights for x in blocks])


def best_vote(votes: Float[np.ndarray, " v"], weights: Float[np.ndarray, " v"]) -> float:
    """The height with most votes: the mean of those about it."""
    tried = few(votes)
    middle = tried[np.argmax(support(tried, votes, weights))]
    near = weights * np.exp(-0.5 * ((votes - middle) / SPREAD_M) ** 2)
    return float(near @ votes / near.sum())


def doubtful(votes: Float[np.ndarray, " v"], weights: Float[np.ndarray, " v"]) -> bool:
    """Whether another height has clearly more votes than none."""
    most = support(few(votes), votes, weights).max()
    return bool(support(np.zeros(1), votes, weights)[0] < AS_GOOD_VOTES * most)
