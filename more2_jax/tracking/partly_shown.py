"""Parts of an object that the other scan hardly shows: joined where it does not show that they are missing.

Beyond the paper, which takes masks as true. What touches an object and is none of it stays behind when that moves: the
other scan then shows empty space where it would be had it come along.
"""

from __future__ import annotations

import numpy as np

from more2_jax.geometry.near_points import NearClouds, ball_around
from more2_jax.geometry.poses import Points, Pose, apply_pose
from more2_jax.geometry.seen_space import CELL_M, SeenSpace
from more2_jax.geometry.touching_surfaces import touch
from more2_jax.matching.metric_evidence import APART_M

# Chosen on rooms of regime `real`, docs/developing/notebook/mask_parts.md.
SOME_ON = 0.2  # share of a part that lies on the object, as the other scan shows it:
MOST_EMPTY = 1 / 3  # at most such a share of it may then lie where that scan looked and found nothing,
HARDLY_EMPTY = 0.15  # and so much where less lies on the object, which moved
MOVED_M = 0.1  # on average, farther than a pose and a frame are off
DOWN_M = 3.0  # so far below a place lies the floor that it is seen against


def coming_along(
    on: float, own: Points, part: Points, T_there: Pose, T_rest: Pose | None, other: NearClouds | None
) -> float | None:
    """How surely, 0 to 1, a part is of the object that it touches; None where it is not, or nobody knows.

    Args:
        on: share of the part that lies on the object as the other scan shows it, where its pose may be trusted.
        own: what the scan that shows the part shows of the object, in one frame with `part`.
        T_there: where both are in the other scan if the part moved as the object did; z up.
        T_rest: the same if nothing moved; None where that is not known.
        other: all that the other scan shows; None where that is not known.
    """
    if other is None or not touch(own, part):
        return None
    there = apply_pose(T_there, part)
    moved = T_rest is not None and off_m(there, apply_pose(T_rest, part)) > MOVED_M
    if on < SOME_ON and not moved:
        return None
    empty = share_empty(there, other)
    return 1 - empty if empty <= (MOST_EMPTY if on >= SOME_ON else HARDLY_EMPTY) else None


def off_m(one: Points, other: Points) -> float:
    """Mean distance between the same points in two places."""
    return float(np.linalg.norm(one - other, axis=1).mean())


def share_empty(place: Points, scan: NearClouds) -> float:
    """Share of a cloud that lies where a scan looked and found nothing; z up."""
    center, radius = ball_around(place)
    beside = np.full(3, CELL_M + APART_M)
    low, high = place.min(axis=0) - beside - [0, 0, DOWN_M], place.max(axis=0) + beside
    near = scan.near([center], radius + DOWN_M).around_box(low, high)
    return float(SeenSpace([near]).empty(place, APART_M).mean())
