"""How a scan's frame lies in the scene's: a common height first, then the motion that most of what stayed agrees on.

Beyond the paper (preset `robust`). The scene's frame is that of its first scan. Heights, "it did not move" and the
metres that a thing moved mean nothing until scans are in one frame.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float

from more2_jax.config import SceneConfig
from more2_jax.consensus import (
    FEWEST,
    ROOM_WORSE,
    Votes,
    estimate,
    most_agreed,
    position_sigma,
    room_misfit,
    with_errors,
)
from more2_jax.metrics import apply_pose
from more2_jax.prior import Prior
from more2_jax.sight import moved_sight
from more2_jax.types import Embedding, Frame, move_embedding
from more2_jax.verification import Known, PairFits, assign, compared, fit_pairs, heights, proposal_of

Pose = Float[np.ndarray, "4 4"]
Points = Float[np.ndarray, "_ 3"]

SPREAD_M = 0.015  # of the votes for a height
AS_GOOD_VOTES = 0.8  # share of the most votes at which heights that agree are not doubted
CLEARLY = 3.0  # of log odds over a scene: what a change of height must explain beyond none at all
LAYER_M = 0.02  # thickness of the layers among which a floor is sought
STRAY = (0.002, 0.998)  # quantiles of height outside of which points are none of a room's
FLOOR_SHARE = 0.3  # of the fullest layer: the lowest that holds as much is the floor
GIVEN_M = 0.01  # by more than this a frame as given is off where another takes its place,
MUCH_LESS = 0.5  # which leaves at most this share of what the given one leaves of the votes,
SURE = 2.0  # and by more than this many standard errors
LEAST_M = 0.005  # a smaller lift is none


@dataclass(frozen=True, kw_only=True)
class Rooms:
    """What is not an instance, of the scene so far (scene's frame) and of the new scan (its own), metres."""

    scene: Points = field(default_factory=lambda: np.zeros((0, 3)))
    scan: Points = field(default_factory=lambda: np.zeros((0, 3)))


def moved_embedding(e: Embedding, T_b_a: Pose) -> Embedding:
    """The embedding in another frame: turned about its origin, which moves along in float64."""
    turn = jaxlie.SE3.from_rotation(jaxlie.SO3.from_matrix(jnp.asarray(T_b_a[:3, :3], jnp.float32)))
    origin = apply_pose(T_b_a, np.asarray(e.origin, np.float64)[None])[0]
    return jax.tree.map(np.asarray, dataclasses.replace(move_embedding(e, turn), origin=origin))


def moved(known: Known, T_b_a: Pose) -> Known:
    """What is known of an object, in another frame."""
    if np.array_equal(T_b_a, np.eye(4)):
        return known
    embedding = moved_embedding(known.embedding, T_b_a)
    sight = None if known.sight is None else moved_sight(known.sight, T_b_a)
    return dataclasses.replace(
        known, points=apply_pose(T_b_a, known.points), embedding=embedding, sight=sight
    )


def lift(height_m: float) -> Pose:
    """A shift along z."""
    T = np.eye(4)
    T[2, 3] = height_m
    return T


def common_frame(
    prior: Prior, old: Sequence[Known], new: Sequence[Known], config: SceneConfig, rooms: Rooms
) -> tuple[Frame, PairFits]:
    """The frame of a new scan, and how its instances (`new`, own frame) then fit the objects (`old`, scene's)."""
    height, fits = common_height(prior, old, new, config, rooms) if config.upright else (0.0, None)
    fits = fits or fit_pairs(prior, old, new, config)
    lifted = lift(height)
    pairs = np.argwhere(fits.odds > 0)
    votes = Votes(
        T_scene_scan=fits.T_old_new[tuple(pairs.T)] @ lifted,
        center=np.stack([k.points.mean(axis=0) for k in new])[pairs[:, 1]],
        object=pairs[:, 0],
        instance=pairs[:, 1],
    )
    T = most_agreed(votes, config.upright, lifted)
    misfit, before = (room_misfit(x, rooms.scene, rooms.scan) for x in (T, lifted))
    return Frame(T_scene_scan=T if misfit <= ROOM_WORSE * before else lifted), fits


def settled_frame(
    frame: Frame, places: Sequence[Pose], centers: Points, sigma_m: Sequence[float], upright: bool
) -> Frame:
    """The frame by least squares over registered pairs: those that agree with it stayed, as far as is known.

    `places`: T_scene_scan as if the object had not moved, `centers`: mean points (scan's frame), `sigma_m`: errors,
    one a pair. A frame that was given is kept unless another is clearly better.
    """
    every = np.arange(len(places))
    votes = Votes(T_scene_scan=np.stack(places)[:, None], center=centers, object=every, instance=every)
    given = with_errors(frame.T_scene_scan, votes, upright)
    found = estimate(frame.T_scene_scan, votes, upright, np.asarray(sigma_m))
    here, there = (apply_pose(x.T_scene_scan, centers) for x in (given, found))
    apart = float(np.sqrt(np.mean(np.sum((here - there) ** 2, axis=1))))
    as_given = np.array_equal(frame.T_scene_scan, np.eye(4))
    least = max(GIVEN_M, SURE * position_sigma(found, there)) if as_given else 0.0
    better = found.cost < (MUCH_LESS * given.cost if as_given else given.cost)
    best = found if found.agreeing >= FEWEST and better and apart > least else given
    if best.agreeing < FEWEST:
        return frame
    return Frame(
        T_scene_scan=best.T_scene_scan,
        sigma_m=position_sigma(best, apply_pose(best.T_scene_scan, centers)),
        sigma_deg=float(np.rad2deg(np.sqrt(np.trace(best.covariance[3:, 3:])))),
    )


# --- the height ---------------------------------------------------------------------------------------------


def common_height(
    prior: Prior, old: Sequence[Known], new: Sequence[Known], config: SceneConfig, rooms: Rooms
) -> tuple[float, PairFits]:
    """What to add to a scan's heights, metres, and how pairs then fit: the lift that explains the scans best.

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
    prior: Prior, old: Sequence[Known], new: Sequence[Known], config: SceneConfig, height_m: float
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
    old: Sequence[Known], new: Sequence[Known], config: SceneConfig
) -> tuple[Float[np.ndarray, " v"], Float[np.ndarray, " v"]]:
    """Differences of the bottoms and of the tops of likely pairs, metres, and their weights."""
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


def floor_height(background: Points) -> float | None:
    """Height of the lowest layer that holds a good part of the fullest one's points, metres; None without points."""
    if not len(background):
        return None
    # A stray point a kilometre off must not make a million layers.
    least, most = np.quantile(background[:, 2], STRAY)
    z = background[(background[:, 2] >= least) & (background[:, 2] <= most), 2]
    count, edges = np.histogram(z, bins=max(1, int(np.ceil(np.ptp(z) / LAYER_M))))
    lowest = int(np.argmax(count >= FLOOR_SHARE * count.max()))
    inside = (z >= edges[lowest] - LAYER_M) & (z <= edges[lowest + 1] + LAYER_M)
    return float(np.median(z[inside]))
