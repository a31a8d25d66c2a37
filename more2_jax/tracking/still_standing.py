"""What still stands where it stood has not moved: evidence against pairs that are said to have.

Beyond the paper. A scan shows surfaces of its own in the place of an object that stayed, under whichever mask, if any.
Where something moved to, nothing stood before.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from jaxtyping import Float

from more2_jax.geometry.poses import Points, apply_pose
from more2_jax.matching.assignment import Chosen
from more2_jax.matching.candidates import AlignedPairs
from more2_jax.matching.places import lie_on, stayed
from more2_jax.tracking.looked_at import NEAR_M, STILL_THERE, shares_still_there, spacing_of
from more2_jax.tracking.rooms import LEAST_BACKGROUND, Rooms
from more2_jax.types import Frame

# Chosen on rooms of regime `real` and `sparse`, docs/developing/notebook/still_standing.md.
STANDS = 3.5  # log odds that a pair loses for each of the two that still stands where the other scan has it
POINTS = 1000  # of a cloud, or somewhat more, that tell whether it stands there
NOTHING = np.zeros((0, 3))


def lost_by_standing(
    aligned: AlignedPairs, pairs: Chosen, frame: Frame, rooms: Rooms
) -> Float[np.ndarray, " q"]:
    """Log odds that pairs (object, instance) lose whose object still stands there, or whose instance stood there.

    Only those that moved, and by what is neither of the two. None of a scan whose frame is unknown.
    """
    lost = np.zeros(len(pairs))
    if frame.unknown or not len(pairs):
        return lost
    here = dict(zip(map(tuple, aligned.rows.tolist()), stayed(aligned, frame.T_scene_scan), strict=True))
    new, old = aligned.sides
    clouds = {
        n: (few(old[k].points), apply_pose(frame.T_scene_scan, few(new[i].points)))
        for n, (k, i) in enumerate(pairs.tolist())
        if not here[k, i]
    }
    moved = [n for n, (a, b) in clouds.items() if lie_on(a, b) < STILL_THERE]
    if not moved:
        return lost

    def shown(side: int) -> Iterator[Points]:
        """What a scan shows, in the scene's frame, its background first."""
        background, objects, T = (
            (rooms.scan, new, frame.T_scene_scan) if side else (rooms.scene, old, np.eye(4))
        )
        yield apply_pose(T, background) if len(background) >= LEAST_BACKGROUND else NOTHING
        yield from (apply_pose(T, o.points) for o in objects)

    # An object is looked for in the new scan, an instance in what was known before.
    near_m = (
        max(NEAR_M, spacing_of(rooms.scene)) if len(rooms.scene) >= LEAST_BACKGROUND else NEAR_M,
        NEAR_M,
    )
    for side in (0, 1):
        places, but = [clouds[n][side] for n in moved], pairs[moved, 1 - side].tolist()
        shares = shares_still_there(places, shown(1 - side), near_m[1 - side], but)
        lost[moved] += STANDS * (np.array(shares) >= STILL_THERE)
    return lost


def few(points: Points) -> Points:
    """`POINTS` of them or somewhat more, at even steps."""
    return points[:: max(1, len(points) // POINTS)]
