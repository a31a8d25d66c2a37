"""Who is who, decided by geometry: the embedding proposes pairs, surfaces say how likely each is one object.

Beyond the paper (preset `robust`). An object and an instance are matched when they are likelier one than two; what
is left over is removed or added, with the probability that it is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from more2_jax.config import SceneConfig
from more2_jax.geometry.padding import bucket
from more2_jax.geometry.poses import in_frames
from more2_jax.matching.assignment import NEVER, LogOdds
from more2_jax.matching.calibration import Compared, calibrated
from more2_jax.matching.color import color_evidence
from more2_jax.matching.pair_evidence import HYPOTHESES, Evidence, asks_prior, pair_evidence
from more2_jax.network.embedding_batch import at_zero, padded, stack, with_origin
from more2_jax.network.prior import Prior, check_embedding
from more2_jax.types import ObservedObject

SMALLEST = 16  # pairs of a compiled call
TOP = 0.99  # share of a cloud's points below its top


@dataclass(frozen=True, kw_only=True)
class PairFits:
    """How every object fits every instance."""

    odds: LogOdds  # of being one; `NEVER` where the embeddings and sizes propose better partners
    T_old_new: Float[np.ndarray, "n m h 4 4"]  # poses that fit, best first, float64; NaN where never tried


@dataclass(frozen=True, kw_only=True)
class Candidates:
    """The pairs of objects and instances that are worth aligning, and all that is known of them; p pairs."""

    among: Bool[np.ndarray, "n m"]
    evidence: Evidence  # its poses are between local frames
    compared: Compared
    T_old_new: Float[np.ndarray, "p h 4 4"]  # those poses between the clouds' frames, float64


def fit_pairs(
    prior: Prior, old: Sequence[ObservedObject], new: Sequence[ObservedObject], config: SceneConfig
) -> PairFits:
    """Aligns the likeliest pairs; all of `old` and `new` in one frame, or in two that differ by any motion.

    Upright, the frames have one height (see `frames.common_height`). Raises ValueError as `check_known` does.
    """
    tried = aligned_candidates(prior, old, new, config)
    odds = np.full(tried.among.shape, NEVER)
    odds[tried.among] = calibrated(tried.evidence, tried.compared, config.registration, config.upright)
    poses = np.full((*tried.among.shape, HYPOTHESES, 4, 4), np.nan)
    poses[tried.among] = tried.T_old_new
    return PairFits(odds=odds, T_old_new=poses)


def aligned_candidates(
    prior: Prior, old: Sequence[ObservedObject], new: Sequence[ObservedObject], config: SceneConfig
) -> Candidates:
    """The likeliest pairs aligned: what `fit_pairs` weighs. Raises ValueError as `check_known` does."""
    check_known(prior, (*old, *new), config)
    known = compared(old, new)
    among = proposed(proposal_of(known, config), config.matching.candidates)
    rows = np.argwhere(among)
    target, source = (padded([k.points for k in side]) for side in (old, new))
    codes = [
        at_zero(with_origin(stack([k.embedding for k in side])[0], np.asarray(cloud.origin)))
        for side, cloud in ((new, source), (old, target))
    ]
    offset = np.asarray(source.origin)[:, None] - np.asarray(target.origin)[None]
    flat = [dataclasses.replace(c, origin=jnp.zeros((len(c.points), 3))) for c in (source, target)]
    pairs = np.zeros((bucket(len(rows), SMALLEST), 2), np.int32)
    pairs[: len(rows)] = rows[:, ::-1]
    found = pair_evidence(
        prior,
        *flat,
        *codes,
        jnp.asarray(offset, jnp.float32),
        jnp.asarray(pairs),
        config.registration,
        config.upright,
    )
    evidence = jax.tree.map(lambda x: np.asarray(x)[: len(rows)], jax.device_get(found))
    origins = np.asarray(target.origin)[rows[:, 0]], np.asarray(source.origin)[rows[:, 1]]
    return Candidates(
        among=among,
        evidence=evidence,
        compared=Compared(**{k: v[among] for k, v in vars(known).items()}),
        T_old_new=in_frames(evidence.poses, *origins),
    )


def check_known(prior: Prior, known: Sequence[ObservedObject], config: SceneConfig) -> None:
    """Raises ValueError where the prior is asked (any orientation, `field_weight`) about another encoder's records."""
    if asks_prior(config.registration, config.upright):
        for k in known:
            check_embedding(prior, k.embedding, "match")


def proposal_of(known: Compared, config: SceneConfig) -> LogOdds:
    """By what the embeddings propose pairs: likeness, less a difference in size."""
    return known.likeness - config.matching.size_weight * known.size


def heights(side: Sequence[ObservedObject]) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Heights of every cloud's lowest and highest points, meters."""
    low, high = np.array([np.quantile(k.points[:, 2], (1 - TOP, TOP)) for k in side]).T
    return low, high


def compared(old: Sequence[ObservedObject], new: Sequence[ObservedObject]) -> Compared:
    """Every object with every instance, by size, code, height and color."""
    a, b = (np.array([float(k.embedding.scale) for k in side]) for side in (old, new))
    x, y = (np.stack([np.asarray(k.embedding.inv, np.float64) for k in side]) for side in (old, new))
    x, y = (v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-30) for v in (x, y))
    (_, top), (_, other) = heights(old), heights(new)
    return Compared(
        size=np.abs(np.log(a[:, None] / b)),
        likeness=x @ y.T,
        top_m=np.abs(top[:, None] - other),
        color=color_evidence([k.color for k in old], [k.color for k in new]),
    )


def proposed(score: LogOdds, count: int) -> Bool[np.ndarray, "n m"]:
    """True for the best `count` of every row and of every column; all where `count` is 0."""
    if not count:
        return np.ones(score.shape, bool)
    rows = np.argsort(np.argsort(-score, axis=1, kind="stable"), axis=1) < count
    columns = np.argsort(np.argsort(-score, axis=0, kind="stable"), axis=0) < count
    return rows | columns
