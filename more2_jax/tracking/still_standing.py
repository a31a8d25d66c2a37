"""What still stands where it stood has not moved: evidence against pairs that are said to have.

Beyond the paper. A scan shows surfaces of its own in the place of an object that stayed, under whichever mask, if any.
Where something moved to, nothing stood before.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float

from more2_jax.geometry.poses import Points, Pose, apply_pose
from more2_jax.matching.assignment import Chosen
from more2_jax.matching.candidates import AlignedPairs
from more2_jax.matching.places import OTHER_COLOR, few, stayed
from more2_jax.tracking.looked_at import shares_still_there, spacing_of
from more2_jax.tracking.rooms import LEAST_BACKGROUND, Rooms
from more2_jax.tracking.scan_noise import near_m
from more2_jax.types import Frame

# Chosen on rooms of regime `real` and `sparse`, and real captures: docs/developing/notebook/still_standing.md.
# Log odds that a pair loses for each of the two that still stands where the other scan has it: likely, and surely.
STANDS, SURELY_STANDS = 3.5, 8.0
# Shares of a cloud's points that then lie on the other scan: half may lie on what was put there since; what was turned
# by 6 degrees or shifted by 5 cm shows less than the second in its old place.
LEAST_STANDING, SURELY_STANDING = 0.75, 0.85
POINTS = 1000  # of a cloud, or somewhat more, that tell whether it stands there


def lost_by_standing(
    aligned: AlignedPairs, pairs: Chosen, frame: Frame, rooms: Rooms
) -> Float[np.ndarray, " q"]:
    """Log odds that pairs (object, instance) lose whose object still stands there, or whose instance stood there.

    Only those that went elsewhere: beside one another may lie parts of one thing. None of a scan of unknown frame.
    """
    lost, T = np.zeros(len(pairs)), frame.T_scene_scan
    if frame.unknown or not len(pairs):
        return lost
    new, old = aligned.sides
    stays = dict(zip(map(tuple, aligned.rows.tolist()), stayed(aligned, T), strict=True))
    clouds = {
        n: (few(old[k].points, POINTS), apply_pose(T, few(new[i].points, POINTS)))
        for n, (k, i) in enumerate(pairs.tolist())
        if not stays[k, i]
    }
    moved = [n for n, (a, b) in clouds.items() if apart(a, b)]
    if not moved:
        return lost
    # An object is looked for in the new scan, an instance in what was known before.
    scan = shown(rooms.scan, (o.points for o in new), T)
    before = shown(rooms.scene, (o.points for o in old), np.eye(4))
    near = near_m(frame.noise_m)
    for side, (clouds_there, reach_m) in enumerate(
        ((scan, near), (before, max(near, remembered_spacing(rooms))))
    ):
        other_color = of_other_color(aligned, side)
        but = [
            {other, *other_color[own]} for own, other in (pairs[n, [side, 1 - side]].tolist() for n in moved)
        ]
        shares = shares_still_there([clouds[n][side] for n in moved], clouds_there, reach_m, but)
        share = np.array(shares)
        lost[moved] += np.select(
            [share >= SURELY_STANDING, share >= LEAST_STANDING], [SURELY_STANDS, STANDS], 0.0
        )
    return lost


def standing(
    known: Sequence[Points],
    new: Sequence[Points],
    pairs: Sequence[tuple[int, int]],
    frame: Frame,
    rooms: Rooms,
) -> Bool[np.ndarray, " q"]:
    """Of pairs (object, instance), whether both scans show surfaces, of whatever, where the other has it.

    `known`: clouds of objects (scene's frame); `new`: of instances (scan's frame). None is in a scan of unknown frame.
    """
    T = frame.T_scene_scan
    if frame.unknown or not pairs:
        return np.zeros(len(pairs), bool)
    objects = [few(known[k], POINTS) for k, _ in pairs]
    instances = [apply_pose(T, few(new[i], POINTS)) for _, i in pairs]
    scan, before, near = (
        shown(rooms.scan, new, T),
        shown(rooms.scene, known, np.eye(4)),
        near_m(frame.noise_m),
    )
    shares = (
        shares_still_there(objects, scan, near),
        shares_still_there(instances, before, max(near, remembered_spacing(rooms))),
    )
    return np.min(shares, axis=0) >= SURELY_STANDING


def remembered_spacing(rooms: Rooms) -> float:
    """Between neighboring points of the scene's background; 0 of too few."""
    return spacing_of(rooms.scene) if len(rooms.scene) >= LEAST_BACKGROUND else 0.0


def shown(background: Points, objects: Iterable[Points], T_scene: Pose) -> Iterator[Points]:
    """What a scan shows, in the scene's frame, its background first: none where there is too little."""
    yield apply_pose(T_scene, background if len(background) >= LEAST_BACKGROUND else background[:0])
    yield from (apply_pose(T_scene, points) for points in objects)


def of_other_color(aligned: AlignedPairs, side: int) -> dict[int, set[int]]:
    """By object (side 0) or instance (1), those of the other scan that are another thing, be they alike in shape."""
    found = defaultdict[int, set[int]](set)
    for pair in aligned.rows[aligned.compared.color <= OTHER_COLOR].tolist():
        found[pair[side]].add(pair[1 - side])
    return found


def apart(a: Points, b: Points) -> bool:
    """Whether the boxes of two clouds do not meet."""
    low, high = np.maximum(a.min(axis=0), b.min(axis=0)), np.minimum(a.max(axis=0), b.max(axis=0))
    return bool((low > high).any())
