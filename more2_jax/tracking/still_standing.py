"""What still stands where it stood has not moved: evidence against pairs that are said to have.

Beyond the paper. A scan shows surfaces of its own in the place of an object that stayed, under whichever mask, if any.
Where something moved to, nothing stood before.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from more2_jax.geometry.poses import Points, Pose, apply_pose
from more2_jax.matching.assignment import Chosen
from more2_jax.matching.candidates import AlignedPairs
from more2_jax.matching.places import OTHER_COLOR, few, stayed
from more2_jax.tracking.looked_at import distances_to_shown, shares_still_there, spacing_of
from more2_jax.tracking.rooms import LEAST_BACKGROUND, Rooms
from more2_jax.tracking.scan_noise import near_m
from more2_jax.types import Frame

# Chosen on rooms of regime `real` and `sparse`, and real captures: docs/developing/notebook/still_standing.md.
# Log odds that a pair loses for each of the two that still stands where the other scan has it: likely, and surely.
STANDS, SURELY_STANDS = 3.5, 8.0
# Shares of a cloud's points that then lie on the other scan: half may lie on what was put there since; what was turned
# by 6 degrees or shifted by 5 cm shows less than the second in its old place.
LEAST_STANDING, SURELY_STANDING = 0.75, 0.85
# What the other scan shows in its place may be so many times as far off as object and instance are from one another at
# another pose: where both clouds lie there, and where one does.
BOTH_STAND, ONE_STANDS = 1.3, 1.0
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
    T_scene_new: Float[np.ndarray, "q 4 4"],
    frame: Frame,
    rooms: Rooms,
) -> Bool[np.ndarray, " q"]:
    """Of pairs (object, instance) that registration moved, which did not move by what either scan shows there.

    Where something stays, each scan shows surfaces, of whatever mask, where the other has it. They are about as near as
    object and instance are to one another at the registered pose, `T_scene_new`. Of a mask that holds more than the
    object, or less, one cloud alone may stand. `known`: clouds of objects (scene's frame); `new`: of instances
    (scan's frame). None stands in a scan of unknown frame.
    """
    T = frame.T_scene_scan
    if frame.unknown or not pairs:
        return np.zeros(len(pairs), bool)
    near = near_m(frame.noise_m)
    reach = near, max(near, remembered_spacing(rooms))
    objects, instances = (
        [few(side[n], POINTS) for n in rows]
        for side, rows in zip((known, new), zip(*pairs, strict=True), strict=True)
    )
    at_rest = (
        distances_to_shown(objects, shown(rooms.scan, new, T), reach[0]),
        distances_to_shown(
            [apply_pose(T, p) for p in instances], shown(rooms.scene, known, np.eye(4)), reach[1]
        ),
    )
    each = list(zip(pairs, T_scene_new, objects, instances, strict=True))
    moved = (
        [distances(p, apply_pose(T_k, new[i]), reach[0]) for (_, i), T_k, p, _ in each],
        [distances(apply_pose(T_k, p), known[k], reach[1]) for (k, _), T_k, _, p in each],
    )
    shares = np.array([[np.isfinite(d).mean() for d in side] for side in at_rest])
    farther = np.choose((shares >= SURELY_STANDING).sum(axis=0), [0.0, ONE_STANDS, BOTH_STAND])
    return mean_distances(at_rest, reach) <= farther * mean_distances(moved, reach)


def distances(points: Points, cloud: Points, reach_m: float) -> Float[np.ndarray, " n"]:
    """Of points to the nearest of a cloud, infinite beyond `reach_m`."""
    return KDTree(cloud).query(points, distance_upper_bound=reach_m)[0]


def mean_distances(
    sides: tuple[Sequence[Float[np.ndarray, " _"]], ...], reach_m: tuple[float, float]
) -> Float[np.ndarray, " q"]:
    """Of pairs, how far either cloud lies off, both ways together; what is beyond reach lies as far as that."""
    means = [[np.minimum(d, r).mean() for d in side] for side, r in zip(sides, reach_m, strict=True)]
    return np.sum(means, axis=0)


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
