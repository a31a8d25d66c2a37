"""The height of a scan's frame in the scene's: proposed by floors, tops and bottoms, decided by how pairs then fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from more2_jax.config import SceneConfig
from more2_jax.geometry.floor import floor_height
from more2_jax.geometry.poses import Points
from more2_jax.geometry.transform import lift, moved
from more2_jax.matching.assignment import assign
from more2_jax.matching.candidates import PairFits, compared, fit_pairs, heights, proposal_of
from more2_jax.network.prior import Prior
from more2_jax.types import ObservedObject

SPREAD_M = 0.015  # of the votes for a height


AS_GOOD_VOTES = 0.8  # share of the most votes at which heights that agree are not doubted


CLEARLY = 3.0  # of log odds over a scene: what a change of height must explain beyond none at all


LEAST_M = 0.005  # a smaller lift is none


@dataclass(frozen=True, kw_only=True)
class Rooms:
    """What is not an instance, of the scene so far (scene's frame) and of the new scan (its own), meters."""

    scene: Points = field(default_factory=lambda: np.zeros((0, 3)))
    scan: Points = field(default_factory=lambda: np.zeros((0, 3)))


def common_height(
    prior: Prior,
    old: Sequence[ObservedObject],
    new: Sequence[ObservedObject],
    config: SceneConfig,
    rooms: Rooms,
) -> tuple[float, PairFits]:
    """What to add to a scan's heights, meters, and how pairs then fit: the lift that explains the scans best.

    Nothing, unless most tops and bottoms of likely pairs agree on something else, and pairs fit clearly better.
    """
    votes, weights = height_votes(old, new, config)
    none = fit_pairs(prior, old, new, config)
    candidates = {best_vote(votes, weights)} if doubtful(votes, weights) else set()
    floors = [floor_height(p) for p in (rooms.scene, rooms.scan)]
    if floors[0] is not None and floors[1] is not None:
        candidates.add(floors[0] - floors[1])
    best, height = none, 0.0
    for lifted_m in sorted(c for c in candidates if abs(c) > LEAST_M):
        found, fits = settled(prior, old, new, config, lifted_m)
        margin = CLEARLY if height == 0.0 else 0.0
        if explained(fits) > explained(best) + margin:
            best, height = fits, found
    return height, best


def settled(
    prior: Prior,
    old: Sequence[ObservedObject],
    new: Sequence[ObservedObject],
    config: SceneConfig,
    height_m: float,
) -> tuple[float, PairFits]:
    """A height corrected by the pairs that it makes fit, and how they fit then."""
    fits = fit_pairs(prior, old, [moved(k, lift(height_m)) for k in new], config)
    pairs = assign(fits.odds, np.zeros(fits.odds.shape), 0.0)
    if len(pairs) < 2:
        return height_m, fits
    more = float(np.median(fits.T_old_new[pairs[:, 0], pairs[:, 1], 0, 2, 3]))
    if not LEAST_M < abs(more) < 0.1:
        return height_m, fits
    again = fit_pairs(prior, old, [moved(k, lift(height_m + more)) for k in new], config)
    return (height_m + more, again) if explained(again) > explained(fits) else (height_m, fits)


def explained(fits: PairFits) -> float:
    """Log odds of the likeliest assignment against no pair at all."""
    pairs = assign(fits.odds, np.zeros(fits.odds.shape), 0.0)
    return float(fits.odds[tuple(pairs.T)].sum())


def height_votes(
    old: Sequence[ObservedObject], new: Sequence[ObservedObject], config: SceneConfig
) -> tuple[Float[np.ndarray, " v"], Float[np.ndarray, " v"]]:
    """Differences of the bottoms and of the tops of likely pairs, meters, and their weights."""
    proposal = proposal_of(compared(old, new), config)
    ranks = [np.argsort(np.argsort(-proposal, axis=a), axis=a) for a in (0, 1)]
    weight = sum(0.5**r for r in ranks)
    differences = [a[:, None] - b for a, b in zip(heights(old), heights(new), strict=True)]
    return np.concatenate([d.ravel() for d in differences]), np.tile(np.ravel(weight), len(differences))


def support(
    at: Float[np.ndarray, " k"], votes: Float[np.ndarray, " v"], weights: Float[np.ndarray, " v"]
) -> Float[np.ndarray, " k"]:
    """Votes for every height, each spread by `SPREAD_M`."""
    return np.exp(-0.5 * ((at[:, None] - votes) / SPREAD_M) ** 2) @ weights


def best_vote(votes: Float[np.ndarray, " v"], weights: Float[np.ndarray, " v"]) -> float:
    """The height with most votes: the mean of those about it."""
    middle = votes[np.argmax(support(votes, votes, weights))]
    near = weights * np.exp(-0.5 * ((votes - middle) / SPREAD_M) ** 2)
    return float(near @ votes / near.sum())


def doubtful(votes: Float[np.ndarray, " v"], weights: Float[np.ndarray, " v"]) -> bool:
    """Whether another height has clearly more votes than none."""
    most = support(votes, votes, weights).max()
    return bool(support(np.zeros(1), votes, weights)[0] < AS_GOOD_VOTES * most)
