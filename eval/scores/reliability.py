"""Whether probabilities hold: what is said against what is true, bin by bin of what is said."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import expit

DRAWS = 400  # of outcomes by chance
BINS = 10  # of equal width, as in Guo et al., On Calibration of Modern Neural Networks, ICML 2017


@dataclass(frozen=True, kw_only=True)
class Bin:
    """What was said with probabilities from `low` to `high`: their mean, the share that is true, and of how many."""

    low: float
    high: float
    said: float
    true: float
    count: int


def reliability(odds: Float[np.ndarray, " p"], one: Bool[np.ndarray, " p"], bins: int = BINS) -> list[Bin]:
    """The reliability curve of log odds: equal bins of probability, those without any left out."""
    said = expit(odds)
    in_bin = np.minimum((said * bins).astype(int), bins - 1)
    return [
        Bin(
            low=k / bins,
            high=(k + 1) / bins,
            said=float(said[in_bin == k].mean()),
            true=float(one[in_bin == k].mean()),
            count=int((in_bin == k).sum()),
        )
        for k in np.unique(in_bin).tolist()
    ]


def calibration_error(odds: Float[np.ndarray, " p"], one: Bool[np.ndarray, " p"], bins: int = BINS) -> float:
    """Expected calibration error: mean difference of what is said and what is true over the bins of `reliability`."""
    curve = reliability(odds, one, bins)
    return sum(b.count * abs(b.said - b.true) for b in curve) / sum(b.count for b in curve)


def error_by_chance(odds: Float[np.ndarray, " p"], bins: int = BINS) -> float:
    """What `calibration_error` would be in the mean if the probabilities were true: of few, more than nothing."""
    said = expit(odds)
    drawn = np.random.default_rng(0).random((DRAWS, len(said))) < said
    return float(np.mean([calibration_error(odds, one, bins) for one in drawn]))
