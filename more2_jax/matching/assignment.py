"""The likeliest assignment of objects to instances, and what it leaves over, from log odds of pairs."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

LogOdds = Float[np.ndarray, "n m"]
FARTHEST_M = 10.0  # what moved farther is no less likely for it
LEAST_GAIN = 0.05  # share of its log odds that motion leaves a pair
AS_GOOD = 1.0  # of log odds: an exchange that loses less is as good
NEVER = -np.inf  # log odds of a pair that is no candidate


def assign(odds: LogOdds, moved_m: Float[np.ndarray, "n m"], weight: float) -> Int[np.ndarray, "p 2"]:
    """The pairs (object, instance) of the likeliest assignment: none that is likelier two objects than one.

    A meter moved takes `weight` off the log odds of pairs that are possible: it decides among identical copies.
    """
    possible = odds > 0
    nearer = odds - weight * np.minimum(moved_m, FARTHEST_M)
    gain = np.where(possible, np.maximum(nearer, LEAST_GAIN * odds), 0.0)
    rows = np.stack(linear_sum_assignment(-gain), axis=1)
    return rows[possible[tuple(rows.T)]]


def interchangeable(odds: LogOdds, pairs: Int[np.ndarray, "p 2"]) -> list[bool]:
    """Of every pair, whether another assignment of it explains the scans as well: identical copies, as a rule."""
    n, m = odds.shape
    free_objects = sorted(set(range(n)) - set(pairs[:, 0]))
    free_instances = sorted(set(range(m)) - set(pairs[:, 1]))

    def exchanged(k: int, i: int) -> bool:
        alone = [odds[k, j] for j in free_instances] + [odds[q, i] for q in free_objects]
        if any(z > max(0.0, odds[k, i] - AS_GOOD) for z in alone):
            return True
        return any(
            min(odds[k, j], odds[q, i]) > 0 and odds[k, j] + odds[q, i] > odds[k, i] + odds[q, j] - AS_GOOD
            for q, j in pairs
            if q != k
        )

    return [exchanged(int(k), int(i)) for k, i in pairs]


def unmatched(
    chance: Float[np.ndarray, "n m"], pairs: Int[np.ndarray, "p 2"]
) -> tuple[dict[int, float], dict[int, float]]:
    """Objects and instances left over, each with the probability that none of the others left over is it.

    `chance`: of every pair, to be one object.
    """
    n, m = chance.shape
    objects = sorted(set(range(n)) - set(pairs[:, 0].tolist()))
    instances = sorted(set(range(m)) - set(pairs[:, 1].tolist()))
    alone = 1 - chance[np.ix_(objects, instances)]
    gone = {k: float(p) for k, p in zip(objects, alone.prod(axis=1), strict=True)}
    return gone, {i: float(p) for i, p in zip(instances, alone.prod(axis=0), strict=True)}
