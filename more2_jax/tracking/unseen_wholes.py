"""Masks in parts of what one scan alone shows: joined where one surface goes on from one to the other.

Beyond the paper, which takes masks as true. Where another scan shows the whole, `joined_masks` and `split_masks` tell
by that. What is new, or gone, no other scan shows: parts of one thing go on smoothly across the border between their
masks, and where one thing stands on another there is a crease.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial

import numpy as np
from scipy.spatial import KDTree

from more2_jax.geometry.poses import Points, apply_pose
from more2_jax.geometry.room_planes import across
from more2_jax.geometry.touching_surfaces import TOUCHING, spacing_of_two, touch
from more2_jax.tracking.comparison import Comparison
from more2_jax.tracking.joined_masks import (
    Join,
    each_once,
    with_instances_joined,
    with_objects_joined,
)
from more2_jax.tracking.looked_at import LEAST_BACKGROUND, cannot_tell, clouds_of, spacing_of
from more2_jax.tracking.regrouped import Regrouped
from more2_jax.tracking.split_masks import Balls
from more2_jax.types import Scan, ScanRecord, SceneObject

# Chosen on rooms of regime `real`, docs/developing/notebook/mask_parts.md.
SMOOTH = float(np.cos(np.deg2rad(30)))  # between normals of neighbors across a border
LEAST_SMOOTH = 0.7  # share of the border that must be smooth
FEWEST = 5  # points of a border


def join_smooth(
    whole: Regrouped, compared: Comparison, scans: Sequence[ScanRecord], scan: Scan
) -> Regrouped | None:
    """Joins what came or went in parts that go on in one another; None of none. `scans`: those before.

    Only where the other scan looked: what merely nobody saw before may be two things side by side, such as cabinets.
    Objects only where they were seen once, in the same scan: two parts of one mask.
    """
    frame = compared.identified.frame
    if frame.unknown or scans[-1].frame.unknown:
        return None
    gone, new = rows_of_once(whole.objects, compared.identified.gone), list(compared.identified.new)
    of_objects = smooth_joins(gone, [o.points for o in compared.old], divided(whole))
    of_instances = smooth_joins(new, [o.points for o in compared.new], whole.halves)
    now = (scan.background, *(i.points for i in whole.instances))
    of_objects = looked_for(
        of_objects,
        [o.points for o in compared.old],
        lambda: (apply_pose(frame.T_scene_scan, points) for points in now),
        compared,
    )
    of_instances = looked_for(
        of_instances,
        [apply_pose(frame.T_scene_scan, o.points) for o in compared.new],
        partial(clouds_of, whole.objects, scans[-1]),
        compared,
    )
    if not of_objects and not of_instances:
        return None
    joined = with_objects_joined(whole, of_objects, compared.prior)
    return with_instances_joined(joined, of_instances, compared.prior)


def rows_of_once(objects: Sequence[SceneObject], rows: Iterable[int]) -> list[int]:
    """Those of the rows whose objects were seen once, by the latest scan that saw such a one."""
    seen = {k: objects[k].observations[0].scan for k in rows if len(objects[k].observations) == 1}
    return [k for k, scan in seen.items() if scan == max(seen.values())]


def divided(whole: Regrouped) -> list[tuple[int, int]]:
    """Objects, by rows, that are halves of one mask."""
    row = {o.id: k for k, o in enumerate(whole.objects)}
    halves = [(r.object, r.divided or "") for r in whole.repairs]
    return [(row[a], row[b]) for a, b in halves if a in row and b in row]


def looked_for(
    joins: Sequence[Join],
    places: Sequence[Points],
    clouds: Callable[[], Iterator[Points]],
    compared: Comparison,
) -> list[Join]:
    """Those joins of which the other scan can tell that it lacks both clouds.

    `places`: the clouds by rows. `clouds`: what the other scan shows, its background first. All in the scene's frame.
    """
    if not joins:
        return []
    background = next(clouds())
    if len(background) < LEAST_BACKGROUND:
        return list(joins)
    rows = [row for j in joins for row in (j.matched, j.part)]
    upright = compared.config.motion == "upright"
    unsure = cannot_tell(
        [places[row] for row in rows],
        clouds,
        upright,
        spacing_of(background),
        compared.identified.frame.noise_m,
    )
    return [j for j, a, b in zip(joins, unsure[::2], unsure[1::2], strict=True) if not a and not b]


def smooth_joins(
    rows: Sequence[int], clouds: Sequence[Points], apart: Sequence[tuple[int, int]] = ()
) -> list[Join]:
    """Which of the clouds of one scan, by rows, go on in one another; the smoothest first, every cloud once.

    Not those that are known to be `apart`: halves of a mask that was divided.
    """
    rows, found = sorted(rows), list[Join]()
    balls, known_apart = Balls.around([clouds[row] for row in rows]), {frozenset(pair) for pair in apart}
    for n, one in enumerate(rows):
        for other in (rows[m] for m in balls.reach(clouds[one]) if m > n):
            if {one, other} in known_apart or not touch(clouds[one], clouds[other]):
                continue
            if (share := smooth_share(clouds[one], clouds[other])) >= LEAST_SMOOTH:
                found.append(Join(matched=one, part=other, share=1.0, odds=0.0, smooth=share))
    return each_once(sorted(found, key=lambda j: -j.smooth))


def smooth_share(one: Points, other: Points) -> float:
    """Share of the border between two clouds across which their surfaces go on; normals are those of each cloud."""
    one, other = np.unique(one, axis=0), np.unique(other, axis=0)
    distance, row = KDTree(other).query(one, distance_upper_bound=TOUCHING * spacing_of_two(one, other))
    border = np.isfinite(distance)
    if border.sum() < FEWEST:
        return 0.0
    facing = np.einsum("bi,bi->b", across(one[border], one), across(other[np.asarray(row)[border]], other))
    return float((np.abs(facing) > SMOOTH).mean())
