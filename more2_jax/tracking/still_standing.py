"""What still stands where it stood has not moved: evidence against pairs that are said to have.

Beyond the paper. A scan shows surfaces of its own in the place of an object that stayed, under whichever mask, if any.
Where something moved to, nothing stood before.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from more2_jax.geometry.poses import Points, apply_pose
from more2_jax.matching.assignment import Chosen
from more2_jax.matching.candidates import AlignedPairs
from more2_jax.matching.places import stayed
from more2_jax.tracking.looked_at import NEAR_M, shares_still_there, spacing_of
from more2_jax.tracking.rooms import LEAST_BACKGROUND, Rooms
from more2_jax.types import Frame

# Chosen on rooms of regime `real` and `sparse`, docs/developing/notebook/still_standing.md.
STANDS = 3.5  # log odds that a pair loses for each of the two that still stands where the other scan has it
LEAST_STANDING = (
    0.75  # share of its points that lie on the other scan: half may lie on what was put there since
)
POINTS = 1000  # of a cloud, or somewhat more, that tell whether it stands there
NOTHING = np.zeros((0, 3))


def lost_by_standing(
    aligned: AlignedPairs, pairs: Chosen, frame: Frame, rooms: Rooms
) -> Float[np.ndarray, " q"]:
    """Log odds that pairs (object, instance) lose whose object still stands there, or whose instance stood there.

    Only those that went elsewhere, as beside one another may lie parts of one thing, and that colors do not tell. None
    of a scan of unknown frame.
    """
    lost = np.zeros(len(pairs))
    if frame.unknown or not len(pairs):
        return lost
    # Copies may have changed places: if colors say so, what stands there now is another one.
    here = stayed(aligned, frame.T_scene_scan) | (aligned.compared.color > 0)
    settled = dict(zip(map(tuple, aligned.rows.tolist()), here, strict=True))
    new, old = aligned.sides
    clouds = {
        n: (few(old[k].points), apply_pose(frame.T_scene_scan, few(new[i].points)))
        for n, (k, i) in enumerate(pairs.tolist())
        if not settled[k, i]
    }
    moved = [n for n, (a, b) in clouds.items() if apart(a, b)]
    if not moved:
        return lost

    def shown(side: int) -> Iterator[Points]:
        """What a scan shows, in the scene's frame, its background first."""
        background, objects = (rooms.scan, new) if side else (rooms.scene, old)
        T = frame.T_scene_scan if side else np.eye(4)
        yield apply_pose(T, background) if len(background) >= LEAST_BACKGROUND else NOTHING
        yield from (apply_pose(T, o.points) for o in objects)

    remembered = spacing_of(rooms.scene) if len(rooms.scene) >= LEAST_BACKGROUND else 0.0
    # An object is looked for in the new scan, an instance in what was known before.
    for side, near_m in enumerate((NEAR_M, max(NEAR_M, remembered))):
        places, but = [clouds[n][side] for n in moved], pairs[moved, 1 - side].tolist()
        shares = shares_still_there(places, shown(1 - side), near_m, but)
        lost[moved] += STANDS * (np.array(shares) >= LEAST_STANDING)
    return lost


def apart(a: Points, b: Points) -> bool:
    """Whether the boxes of two clouds do not meet."""
    low, high = np.maximum(a.min(axis=0), b.min(axis=0)), np.minimum(a.max(axis=0), b.max(axis=0))
    return bool((low > high).any())


def few(points: Points) -> Points:
    """`POINTS` of them or somewhat more, at even steps."""
    return points[:: max(1, len(points) // POINTS)]
