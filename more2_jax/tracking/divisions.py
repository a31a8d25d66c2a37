"""Which clouds are two things: divisions that make more sense of the other scan than the wholes do.

The decision alone, from log odds that surfaces give (`merged_masks`).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from more2_jax.config import MotionModel
from more2_jax.geometry.normalized_cut import Rows
from more2_jax.matching.assignment import NEVER
from more2_jax.types import Embedding

# Chosen on rooms of regime `real`, docs/developing/notebook/mask_repair.md.
SAME_SIZE = 0.8  # |log| of the ratio of the F_s: a half that differs more from every object is not compared
SURE = 7.5  # log odds of a whole that is not divided: clean pairs of one object have 5 to 8


@dataclass(frozen=True, kw_only=True)
class LeastGain:
    """Log odds that halves must have beyond the whole, for most masks hold one object."""

    narrow: float  # where the halves hardly touch,
    wide: float  # elsewhere, where both must be known,
    taken: float  # and where a half is what something else was found to be, hardly


# In any orientation more fits by chance.
LEAST_GAIN: dict[MotionModel, LeastGain] = {
    "upright": LeastGain(narrow=2.2, wide=4.0, taken=4.0),
    "free": LeastGain(narrow=3.8, wide=5.9, taken=6.8),
}


@dataclass(frozen=True, kw_only=True)
class Part:
    """One half of a cloud, as a mask of its own would show it; in the cloud's frame."""

    whole: int  # row of the cloud
    rows: Rows  # its points
    embedding: Embedding
    narrow: bool  # whether the halves hardly touch


@dataclass(frozen=True, kw_only=True)
class Division:
    """A cloud that is two objects, and which of the other scan's each half is; log odds beyond those of the whole."""

    parts: tuple[Part, Part]  # the larger first
    others: tuple[int | None, int | None]  # None: none of those that are left
    gain: float


# Log odds of parts with those of the other scan's clouds that are named, by the numbers of both in these lists:
# (other, part), among those that are asked for. What cannot be one is left out.
Pairs = Collection[tuple[int, int]]
Weigh = Callable[[Sequence[Part], Sequence[int], Pairs], Mapping[tuple[int, int], float]]


@dataclass(frozen=True, kw_only=True)
class Wholes:
    """How the clouds of one scan stand to those of the other, before any is divided."""

    partner: Mapping[int, int]  # what a cloud was found to be
    left: Sequence[int]  # rows of the other scan's clouds that nothing was found to be
    scale: Sequence[float]  # F_s of the other scan's clouds
    odds: Mapping[int, float]  # log odds of a cloud with its partner
    least: LeastGain  # of its divisions
    both_known: bool = False  # whether both halves must be, wherever they touch
    # As `left`, though something was found to be each, hardly: log odds that are lost with it.
    doubtful: Mapping[int, float] = field(default_factory=dict)

    def in_doubt(self, whole: int) -> bool:
        """Whether a division of the cloud could say what those left are."""
        if whole in self.partner:
            return len(self.to_be_had(whole)) > 0 and self.odds[whole] < SURE
        return len(self.to_be_had(whole)) > 1

    @property
    def may_be_taken(self) -> list[int]:
        """Those of the other scan that parts of any cloud may be."""
        return sorted({*self.left, *self.doubtful})

    def to_be_had(self, whole: int) -> list[int]:
        """The same, a cloud's own partner aside."""
        return [k for k in self.may_be_taken if k != self.partner.get(whole)]

    def may_be(self, part: Part) -> list[int]:
        """Those of the other scan that a half may be: to be had or its whole's, of about its size."""
        own = [self.partner[part.whole]] if part.whole in self.partner else []
        rows = [*self.to_be_had(part.whole), *own]
        ratio = np.log(float(part.embedding.scale) / np.array([self.scale[k] for k in rows]))
        return [k for k, r in zip(rows, ratio, strict=True) if abs(r) < SAME_SIZE]

    def lost(self, whole: int, taken: Iterable[int]) -> float:
        """Log odds that are lost with a whole, and with what its halves take from others."""
        with_whole = max(self.odds[whole], 0.0) if whole in self.partner else 0.0
        return with_whole + sum(max(self.doubtful[k], 0.0) for k in taken)

    def taken(self, whole: int, others: Iterable[int | None]) -> list[int]:
        """Which of these something other than the whole was found to be."""
        return [k for k in others if k is not None and k in self.doubtful and k != self.partner.get(whole)]

    def enough(self, division: Division) -> bool:
        """Whether a division gains enough. One that says what none is which is missing needs one to be missing."""
        whole = division.parts[0].whole
        if not (self.left or set(division.others) - {None, self.partner.get(whole)}):
            return False
        if self.taken(whole, division.others) and division.gain <= self.least.taken:
            return False
        known = None not in division.others
        if division.parts[0].narrow and (known or not self.both_known):
            return division.gain > self.least.narrow
        return known and division.gain > self.least.wide


def chosen(halves: Sequence[tuple[Part, Part]], wholes: Wholes, weigh: Weigh) -> list[Division]:
    """The divisions that are likelier than the wholes; each cloud once, each of the other scan's once."""
    halves = [pair for pair in halves if any(wholes.may_be(p) for p in pair)]
    if not halves:
        return []
    others = sorted({k for pair in halves for p in pair for k in wholes.may_be(p)})
    parts, row = [p for pair in halves for p in pair], {k: n for n, k in enumerate(others)}
    odds = weigh(parts, others, {(row[k], n) for n, p in enumerate(parts) for k in wholes.may_be(p)})
    return compatible(
        [
            division
            for n, pair in enumerate(halves)
            for division in proposals(
                pair,
                [
                    {k: odds.get((row[k], 2 * n + side), NEVER) for k in wholes.may_be(p)}
                    for side, p in enumerate(pair)
                ],
                wholes,
            )
        ]
    )


def proposals(pair: tuple[Part, Part], odds: Sequence[Mapping[int, float]], wholes: Wholes) -> list[Division]:
    """What two halves may be, where that gains enough. `odds`: of each with what it may be."""
    fits = [{None: 0.0} | {k: o for k, o in of_half.items() if o > 0} for of_half in odds]
    found = []
    for first, second in itertools.product(*fits):
        whole, others = pair[0].whole, (first, second)
        gain = fits[0][first] + fits[1][second] - wholes.lost(whole, wholes.taken(whole, others))
        division = Division(parts=pair, others=others, gain=float(gain))
        if first != second and wholes.enough(division):
            found.append(division)
    return found


def compatible(proposals: Sequence[Division]) -> list[Division]:
    """The best proposals that share no cloud."""
    kept: list[Division] = []
    for d in sorted(proposals, key=lambda d: -d.gain):
        clash = any(
            d.parts[0].whole == e.parts[0].whole or (set(d.others) & set(e.others)) - {None} for e in kept
        )
        if not clash:
            kept.append(d)
    return kept
