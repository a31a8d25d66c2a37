"""Where a new scan lies by the rooms themselves: floor, walls and what stayed, laid onto one another.

Beyond the paper (preset `robust`). Where most objects moved, or masks hide that they stayed, few agree on a frame, and
the room still tells it. But a rectangular room fits itself turned by half a turn: of the poses that fit, the one is
taken at which most objects lie where they lay.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from more2_jax.config import MotionModel
from more2_jax.geometry.poses import Points, Pose, apply_pose
from more2_jax.geometry.room_alignment import CLEARLY, DIFFERENT_M, RoomFit
from more2_jax.tracking.pose_voting import Votes, agreement
from more2_jax.tracking.rooms import Rooms
from more2_jax.types import Frame

OFF_M, OFF_DEG = 0.02, 0.5  # by which such frames are off, in the median: drift bends rooms
CLEARLY_OFF_M = 2 * OFF_M  # a frame as given is off where rooms say so by more
SOME = 100  # points of a scan
ALONE = 5  # objects that agree on a frame at which the rooms do not fit; three did by chance
ENOUGH = 2  # objects that agree outweigh how closely the rooms fit


def frame_by_rooms(rooms: Rooms, votes: Votes, motion: MotionModel, given: Pose) -> Frame | None:
    """The frame of a scan that does not lie as given, `unknown` where it is not told; None where nothing says so.

    Args:
        rooms: both, z up to about 10°.
        votes: where pairs that are likely one object would put the scan.
        motion: upright: the pose turns about the vertical only, and lifts as `given` does.
        given: the frame that is taken if there is no other.
    """
    if not rooms.fits:
        return frame_near_given(rooms, votes, motion, given)
    T, as_given = most_likely(rooms.fits, votes), agreement(given, votes)[0]
    if T is None or agreement(T, votes)[0] < as_given:
        return None if as_given else Frame(T_scene_scan=given, unknown=True)
    T = upright(T, rooms.scan, given) if motion == "upright" else T
    return Frame(T_scene_scan=T, sigma_m=OFF_M, sigma_deg=OFF_DEG)


def frame_near_given(rooms: Rooms, votes: Votes, motion: MotionModel, given: Pose) -> Frame | None:
    """The frame of a scan that lies nearly as given, by some centimeters or degrees; None where it lies as given.

    Scans of one recording that a tracker has laid on one another are off by more than fused rooms are.
    """
    fit = rooms.clearly_near_given()
    if fit is None:
        return None
    T = upright(fit.T_a_b, rooms.scan, given) if motion == "upright" else fit.T_a_b
    if apart_m(T, given, rooms.scan) < CLEARLY_OFF_M or agreement(T, votes)[0] < agreement(given, votes)[0]:
        return None
    return Frame(T_scene_scan=T, sigma_m=OFF_M, sigma_deg=OFF_DEG)


def apart_m(T: Pose, other: Pose, points: Points) -> float:
    """Mean distance between the places that two poses give to some points of a scan."""
    some = points[:: max(1, len(points) // SOME)]
    return float(np.linalg.norm(apply_pose(T, some) - apply_pose(other, some), axis=1).mean())


def borne_out(T_scene_scan: Pose, rooms: Rooms, votes: Votes) -> bool:
    """Whether rooms, where they fit at some poses, fit at this one, or too many objects agree on it for chance."""
    fits = rooms.fits if rooms.near_given is None else [rooms.near_given]
    if not fits or agreement(T_scene_scan, votes)[0] >= ALONE:
        return True
    return min(apart_m(f.T_a_b, T_scene_scan, rooms.scan) for f in fits) < DIFFERENT_M


def most_likely(fits: Sequence[RoomFit], votes: Votes) -> Pose | None:
    """The fit that most objects agree with, then the closest; None where no object does, or another is as likely."""
    if not len(votes.center):
        return None
    ranked = sorted(((agreement(f.T_a_b, votes)[0], f.closeness, f.T_a_b) for f in fits), key=lambda x: x[:2])
    if not ranked or not ranked[-1][0]:
        return None
    agree, closeness, T = ranked[-1]
    for others, rival, _ in ranked[:-1]:
        clearly_more = agree >= ENOUGH and others < agree
        if not clearly_more and rival >= CLEARLY * closeness:
            return None
    return T


def upright(T: Pose, points: Points, given: Pose) -> Pose:
    """The pose without its tilt, and at the height of `given`: the middle of the points stays where it put it."""
    middle, level = points.mean(axis=0, keepdims=True), np.eye(4)
    yaw = np.arctan2(T[1, 0] - T[0, 1], T[0, 0] + T[1, 1])
    level[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    level[:3, 3] = (apply_pose(T, middle) - apply_pose(level, middle))[0]
    level[2, 3] = given[2, 3]
    return level
