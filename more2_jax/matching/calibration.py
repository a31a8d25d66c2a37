"""Log odds that two clouds show one object, from what is known of the pair: logistic regression on validation rooms.

Beyond the paper (`EvidenceMatcher`). How the weights were fitted, and how well they hold, is in
docs/developing/notebook/matching_evidence.md; `python -m eval.calibration` fits them anew for other weights of the
prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import expit, logit

from more2_jax.config import MotionModel, SurfaceSearch
from more2_jax.matching.pair_evidence import PairEvidence, asks_prior


@dataclass(frozen=True, kw_only=True)
class Compared:
    """What is known of pairs without aligning them."""

    size: Float[np.ndarray, "*pairs"]  # |log| of the ratio of the F_s
    likeness: Float[np.ndarray, "*pairs"]  # cosine of the F_inv
    top_m: Float[np.ndarray, "*pairs"]  # difference of the heights of their highest points
    color: Float[np.ndarray, "*pairs"]  # log likelihood ratio of their colors (`color.color_evidence`)
    # 0 to 1: small enough to be put on furniture, and off it.
    portable: Float[np.ndarray, "*pairs"] | float = 0.0


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Log odds that two clouds show one object, linear in what is known of the pair.

    Every piece of evidence is bounded, so that none outvotes all others where a mask is cut or dirty.
    """

    intercept: float
    likeness: float
    apart_less: float  # of the smaller mean distance of the two ways, truncated at `APART_M`,
    apart_more: float  # and of the larger
    contradicted: float = 0.0  # of the share of either cloud where the other scan shows empty space
    lift: float = 0.0  # of a change of height, in shares of `MOST_LIFT_M`, at most 1
    top: float = 0.0  # of `top_m`, in shares of `HIGHEST_M`, at most 1
    off_less: float = 0.0  # of the smaller distance off the other's completed surface,
    off_more: float = 0.0  # and of the larger
    # Of the intercept, by how much it lowers the threshold of an assignment: pairs that win one are likelier right than
    # others, and a pair missed is two false changes. No part of a probability.
    raised: float = 0.0


MOST_LIFT_M = 0.05  # what scans of things that stand on a floor differ in height by noise alone, and more
HIGHEST_M = 0.05  # a mask that is cut at the top hides how high the object is
# Share of what heights cost that is taken off for a small thing: cut masks make large ones look small, too.
CARRIED = 0.5
UNKNOWN = 0.5  # of `off_own`: a prior that lays a cloud so far off its own surface has no say


# Logistic regression on pairs of validation rooms; how, and how well it holds:
# docs/developing/notebook/matching_evidence.md.
UPRIGHT = Calibration(
    intercept=8.2,
    likeness=0.9,
    apart_less=-6.6,
    apart_more=-2.6,
    contradicted=-4.1,
    lift=-2.5,
    top=-3.0,
    raised=2.25,
)
FREE = Calibration(
    intercept=7.7,
    likeness=3.0,
    apart_less=-7.1,
    apart_more=-1.3,
    off_less=-10.0,
    off_more=-11.2,
    raised=2.5,
)
# Without the prior's say.
UNASKED = Calibration(intercept=3.7, likeness=5.8, apart_less=-6.3, apart_more=-6.1, raised=3.0)
# Of log odds beyond an even chance, what remains in those that a match is told with:
# docs/developing/notebook/told_probabilities.md.
REMAINS = 0.5
FAR_M = 3.0


@dataclass(frozen=True, kw_only=True)
class Told:
    """How sure what an assignment took is told to be. It is likelier right than others of the same log odds."""

    taken: float  # log odds of a pair that is one object or is not with an even chance
    mended: float  # and where it rests on masks that were divided, or that are missing,
    a_meter: float = 0.0  # and for every meter that it moved, up to `FAR_M`


TOLD_UPRIGHT, TOLD_FREE = Told(taken=2.9, mended=-2.9), Told(taken=4.0, mended=-1.3, a_meter=-0.85)
# Log odds that what one scan alone seems to have is not in the other, and what a share of further such things takes.
ALONE, ALONE_LESS = 1.7, 6.2
FEW_THINGS = 8  # as rooms have: of fewer, one more is no larger share


def calibrated(
    evidence: PairEvidence, compared: Compared, search: SurfaceSearch, motion: MotionModel
) -> Float[np.ndarray, "*pairs"]:
    """`log_odds` by the weights fitted for these settings; upright: things stand on the floor of one frame.

    A prior that knows nothing of a pair's clouds has no say in it.
    """
    if motion == "upright":
        return log_odds(evidence, compared, UPRIGHT)
    unasked = log_odds(evidence, compared, UNASKED)
    if not asks_prior(search, motion):
        return unasked
    return np.where(evidence.off_own <= UNKNOWN, log_odds(evidence, compared, FREE), unasked)


def probability(
    odds: Float[np.ndarray, "*pairs"], search: SurfaceSearch, motion: MotionModel
) -> Float[np.ndarray, "*pairs"]:
    """Of pairs to be one object, by their log odds as `calibrated` has them."""
    return expit(odds - even_odds(search, motion))


def told_probability(
    odds: Float[np.ndarray, "*pairs"],
    moved_m: Float[np.ndarray, "*pairs"],
    search: SurfaceSearch,
    motion: MotionModel,
) -> Float[np.ndarray, "*pairs"]:
    """Of pairs that an assignment took to be one object, by their log odds as `calibrated` has them."""
    told = TOLD_UPRIGHT if motion == "upright" else TOLD_FREE
    far = told.a_meter * np.minimum(moved_m, FAR_M)
    return expit(told.taken + far + REMAINS * (odds - even_odds(search, motion)))


def mended_probability(told: float, motion: MotionModel) -> float:
    """What `told_probability` has of a pair, where it rests on masks that were divided or are missing."""
    less = (TOLD_UPRIGHT if motion == "upright" else TOLD_FREE).mended
    return float(expit(logit(told) + less))


def alone_probability(alone: int, things: int) -> float:
    """That what one scan alone seems to have is really not in the other, where nothing that is left there is like it.

    `alone`: how many things seem so, this one among them, of all that either scan has. Many are a sign that masks are
    damaged, or that partners were taken by others.
    """
    share = max(alone - 1, 0) / max(things, FEW_THINGS)
    return float(expit(ALONE - ALONE_LESS * share))


def even_odds(search: SurfaceSearch, motion: MotionModel) -> float:
    """What `calibrated` has of a pair that is one object or is not with an even chance."""
    if motion == "upright":
        return UPRIGHT.raised
    return (FREE if asks_prior(search, motion) else UNASKED).raised


def log_odds(evidence: PairEvidence, compared: Compared, c: Calibration) -> Float[np.ndarray, "*pairs"]:
    """Of every pair to be one object."""
    return weighed(features(evidence, compared), c) + compared.color


def weighed(known: dict[str, Float[np.ndarray, "*pairs"]], c: Calibration) -> Float[np.ndarray, "*pairs"]:
    """Log odds of what is known (`features`) by a calibration; without colors."""
    parts = [getattr(c, name) * value for name, value in known.items()]
    return c.intercept + np.sum(parts, axis=0)


def features(evidence: PairEvidence, compared: Compared) -> dict[str, Float[np.ndarray, "*pairs"]]:
    """What each weight of a `Calibration` is multiplied with, by its name."""
    apart = np.stack([evidence.apart_source, evidence.apart_target])
    off = np.stack([evidence.off_source, evidence.off_target])
    height = 1.0 - CARRIED * np.asarray(compared.portable)
    return {
        "likeness": compared.likeness,
        "apart_less": apart.min(axis=0),
        "apart_more": apart.max(axis=0),
        "contradicted": evidence.contradicted,
        "lift": height * np.minimum(evidence.lift_m / MOST_LIFT_M, 1.0),
        "top": height * np.minimum(compared.top_m / HIGHEST_M, 1.0),
        "off_less": off.min(axis=0),
        "off_more": off.max(axis=0),
    }
