"""How a scan's frame lies in the scene's: a common height first, then the motion that most of what stayed agrees on.

Beyond the paper (preset `robust`). The scene's frame is that of its first scan. Heights, "it did not move" and the
meters that a thing moved mean nothing until scans are in one frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from more2_jax.config import EvidenceMatcher, MotionModel
from more2_jax.geometry.poses import Points, Pose, apply_pose, vertical_shift
from more2_jax.matching.candidates import align_candidates, measured_among, odds_of
from more2_jax.matching.places import with_neighbors
from more2_jax.matching.proposals import is_building, signatures
from more2_jax.network.prior import Prior
from more2_jax.tracking.pose_voting import (
    FEWEST,
    ROOM_WORSE,
    Votes,
    estimate,
    most_agreed,
    position_sigma,
    room_misfit,
    with_errors,
)
from more2_jax.tracking.room_frame import borne_out, frame_by_rooms
from more2_jax.tracking.rooms import Rooms
from more2_jax.tracking.scan_height import Weighed, common_height
from more2_jax.types import Frame, ObservedObject

GIVEN_M = 0.01  # by more than this a frame as given is off where another takes its place,
MUCH_LESS = 0.5  # which leaves at most this share of what the given one leaves of the votes,
SURE = 2.0  # and by more than this many standard errors
ELSEWHERE_M = 3.0  # a building's frame that is off by more hides partners that are sought near by


def common_frame(
    prior: Prior,
    old: Sequence[ObservedObject],
    new: Sequence[ObservedObject],
    matcher: EvidenceMatcher,
    motion: MotionModel,
    rooms: Rooms,
) -> tuple[Frame, Weighed]:
    """The frame of a new scan, and how its instances (`new`, own frame) then fit the objects (`old`, scene's)."""
    if motion == "upright":
        weighed = common_height(prior, old, new, matcher, rooms)
    else:
        aligned = align_candidates(prior, old, new, matcher, motion)
        weighed = Weighed(height_m=0.0, aligned=aligned, odds=odds_of(aligned, matcher.search, motion))
    lifted = vertical_shift(weighed.height_m)
    likely = weighed.odds.value > 0
    pairs = weighed.odds.pairs[likely]
    votes = Votes(
        T_scene_scan=weighed.aligned.T_old_new[likely],
        center=np.stack([o.points.mean(axis=0) for o in new])[pairs[:, 1]],
        object=pairs[:, 0],
        instance=pairs[:, 1],
    )
    building = is_building(signatures(old), signatures(new))
    frame = Frame(T_scene_scan=most_agreed(votes, motion, lifted))
    if not building and (frame.T_scene_scan is lifted or not borne_out(frame.T_scene_scan, rooms, votes)):
        frame = frame_by_rooms(rooms, votes, motion, lifted) or Frame(T_scene_scan=lifted)
    T = frame.T_scene_scan
    misfit, before = (room_misfit(x, rooms.scene, rooms.scan) for x in (T, lifted))
    if misfit > ROOM_WORSE * before:
        return Frame(T_scene_scan=lifted), beside_one_another(prior, weighed, matcher, motion, lifted)
    if building and shift_m(T, lifted, votes.center) > ELSEWHERE_M:
        weighed = sought_there(prior, weighed, matcher, motion, T)
    return frame, beside_one_another(prior, weighed, matcher, motion, T)


def shift_m(T: Pose, other: Pose, points: Points) -> float:
    """How far apart two frames put the same points, in the median; 0 of none."""
    apart = np.linalg.norm(apply_pose(T, points) - apply_pose(other, points), axis=1)
    return float(np.median(apart)) if len(apart) else 0.0


def sought_there(
    prior: Prior, weighed: Weighed, matcher: EvidenceMatcher, motion: MotionModel, T_scene_scan: Pose
) -> Weighed:
    """The pairs of a building anew, partners being sought where its frame has them, which was not known before."""
    new, old = weighed.aligned.sides
    lift = vertical_shift(weighed.aligned.height_m)
    seen = weighed.aligned.seen
    aligned = align_candidates(prior, old, new, matcher, motion, lift, seen, place=T_scene_scan)
    odds = odds_of(aligned, matcher.search, motion, weighed.height_m)
    return Weighed(height_m=weighed.height_m, aligned=aligned, odds=odds)


def beside_one_another(
    prior: Prior, weighed: Weighed, matcher: EvidenceMatcher, motion: MotionModel, T_scene_scan: Pose
) -> Weighed:
    """The same with pairs that the frame lays beside each other, which nobody knew before."""
    aligned = with_neighbors(prior, weighed.aligned, matcher, motion, T_scene_scan)
    odds = odds_of(aligned, matcher.search, motion, weighed.height_m)
    return Weighed(height_m=weighed.height_m, aligned=aligned, odds=odds)


def among_noise(weighed: Weighed, noise_m: float, matcher: EvidenceMatcher, motion: MotionModel) -> Weighed:
    """The same with clouds compared as far as noise puts surfaces apart, where scans have more of it than usual."""
    aligned = measured_among(weighed.aligned, noise_m)
    if aligned is weighed.aligned:
        return weighed
    odds = odds_of(aligned, matcher.search, motion, weighed.height_m)
    return Weighed(height_m=weighed.height_m, aligned=aligned, odds=odds)


def settled_frame(
    frame: Frame, places: Sequence[Pose], centers: Points, sigma_m: Sequence[float], motion: MotionModel
) -> Frame:
    """The frame by least squares over registered pairs: those that agree with it stayed, as far as is known.

    `places`: T_scene_scan as if the object had not moved, `centers`: mean points (scan's frame), `sigma_m`: errors,
    one a pair. A frame that was given is kept unless another is clearly better.
    """
    every = np.arange(len(places))
    votes = Votes(T_scene_scan=np.stack(places)[:, None], center=centers, object=every, instance=every)
    given = with_errors(frame.T_scene_scan, votes, motion)
    found = estimate(frame.T_scene_scan, votes, motion, np.asarray(sigma_m))
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
