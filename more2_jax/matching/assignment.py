"""The likeliest assignment of objects to instances, and what it leaves over, from log odds of pairs.

Of a building only pairs that may be one are listed. An assignment of them falls apart: pairs that share neither an
object nor an instance, nor are linked by others that do, are chosen independently.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

FARTHEST_M = 10.0  # what moved farther is no less likely for it
LEAST_GAIN = 0.05  # share of its log odds that its motion leaves a pair
AS_GOOD = 1.0  # of log odds: an exchange that loses less is as good
NEVER = -np.inf  # log odds of a pair that is no candidate

Pairs = Int[np.ndarray, "p 2"]  # (object, instance): those listed,
Chosen = Int[np.ndarray, "q 2"]  # and some of them


@dataclass(frozen=True, kw_only=True)
class LogOdds:
    """Log odds of pairs to be one object. Those of pairs that are not listed are `NEVER`."""

    pairs: Pairs  # by objects, then by instances; each once
    value: Float[np.ndarray, " p"]
    shape: tuple[int, int]  # numbers of objects and of instances

    @classmethod
    def of(cls, matrix: Float[np.ndarray, "n m"]) -> LogOdds:
        """Those of a matrix that are not `NEVER`."""
        listed = matrix > NEVER
        return cls(pairs=np.argwhere(listed), value=matrix[listed], shape=matrix.shape)

    def matrix(self) -> Float[np.ndarray, "n m"]:
        """All of them; for rooms."""
        found = np.full(self.shape, NEVER)
        found[tuple(self.pairs.T)] = self.value
        return found

    def less(self, lost: Mapping[tuple[int, int], float]) -> LogOdds:
        """The same, less what some of the pairs lose."""
        value = self.value.copy()
        if lost:
            value[self.rows_of(np.array(list(lost)))] -= list(lost.values())
        return replace(self, value=value)

    def rows_of(self, pairs: Chosen) -> Int[np.ndarray, " q"]:
        """Where pairs are listed."""
        return listed_at(self.pairs, pairs, self.shape[1])


def listed_at(listed: Pairs, pairs: Chosen, instances: int) -> Int[np.ndarray, " q"]:
    """Where pairs stand in a list that is sorted by objects, then by instances."""
    known, asked = (p[:, 0] * instances + p[:, 1] for p in (listed, pairs))
    return np.searchsorted(known, asked)


def assign(odds: LogOdds, motion: Float[np.ndarray, " p"] | float = 0.0) -> Chosen:
    """The pairs of the likeliest assignment: none that is likelier two objects than one.

    `motion` of every listed pair is added to the log odds of those that are possible: how likely things move so. It
    decides among identical copies.
    """
    possible = odds.value > 0
    value, pairs = odds.value[possible], odds.pairs[possible]
    likelier = value + np.broadcast_to(motion, odds.value.shape)[possible]
    return pairs[largest_total(pairs, np.maximum(likelier, LEAST_GAIN * value), odds.shape)]


def largest_total(
    pairs: Pairs, gain: Float[np.ndarray, " p"], shape: tuple[int, int]
) -> Bool[np.ndarray, " p"]:
    """Which pairs to choose, no object and no instance twice, for the largest total of their gains, all positive.

    Linked pairs by linked pairs: what a room's objects may be is linked to hardly anything of another room.
    """
    if not len(pairs):
        return np.zeros(0, bool)
    n, m = shape
    ends = pairs[:, 0], n + pairs[:, 1]
    linked = coo_array((np.ones(len(pairs)), ends), shape=(n + m, n + m))
    part = connected_components(linked, directed=False)[1][ends[0]]
    order = np.argsort(part, kind="stable")
    chosen = np.zeros(len(pairs), bool)
    for rows in np.split(order, np.flatnonzero(np.diff(part[order])) + 1):
        (objects, k), (instances, i) = (np.unique(x, return_inverse=True) for x in pairs[rows].T)
        matrix = np.zeros((len(objects), len(instances)))
        matrix[k, i] = gain[rows]
        best = np.zeros(matrix.shape, bool)
        best[linear_sum_assignment(-matrix)] = True
        chosen[rows] = best[k, i]
    return chosen


def interchangeable(odds: LogOdds, pairs: Chosen) -> list[bool]:
    """Of every pair, whether another assignment of it explains the scans as well: identical copies, as a rule."""
    instance_of, object_of = (dict(p) for p in (pairs.tolist(), pairs[:, ::-1].tolist()))
    of_object, of_instance = (
        defaultdict[int, dict[int, float]](dict),
        defaultdict[int, dict[int, float]](dict),
    )
    for (k, i), z in zip(odds.pairs.tolist(), odds.value.tolist(), strict=True):
        if z > 0 or object_of.get(i) == k:
            of_object[k][i] = of_instance[i][k] = z

    def exchanged(k: int, i: int) -> bool:
        own = of_object[k][i]
        alone = [z for j, z in of_object[k].items() if j not in object_of]
        alone += [z for q, z in of_instance[i].items() if q not in instance_of]
        if any(z > max(0.0, own - AS_GOOD) for z in alone):
            return True
        others = [(z, object_of[j], j) for j, z in of_object[k].items() if j != i and j in object_of]
        return any(
            q in of_instance[i] and z + of_instance[i][q] > own + of_object[q][j] - AS_GOOD
            for z, q, j in others
        )

    return [exchanged(k, i) for k, i in pairs.tolist()]


def unmatched(
    odds: LogOdds, chance: Float[np.ndarray, " p"], pairs: Chosen
) -> tuple[dict[int, float], dict[int, float]]:
    """Objects and instances left over, each with the probability that none of the others left over is it.

    `chance`: of every listed pair, to be one object.
    """
    left = [np.ones(count, bool) for count in odds.shape]
    for side in (0, 1):
        left[side][pairs[:, side]] = False
    both = left[0][odds.pairs[:, 0]] & left[1][odds.pairs[:, 1]]
    alone = []
    for side in (0, 1):
        none = np.ones(odds.shape[side])
        np.multiply.at(none, odds.pairs[both, side], 1 - chance[both])
        alone.append({int(k): float(none[k]) for k in np.flatnonzero(left[side])})
    return alone[0], alone[1]
