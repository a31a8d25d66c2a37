"""Masks in parts of what one scan alone shows: joined where one surface goes on from one to the other.

Beyond the paper, which takes masks as true. Where another scan shows the whole, `joined_masks` and `split_masks` tell
by that. What is new, or gone, no other scan shows: parts of one thing go on smoothly across the border between their
masks, and where one thing stands on another there is a crease.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from scipy.spatial import KDTree

from more2_jax.geometry.poses import Points
from more2_jax.geometry.room_planes import across
from more2_jax.tracking.comparison import Comparison
from more2_jax.tracking.joined_masks import (
    TOUCHING,
    Join,
    each_once,
    spacing_of_two,
    touch,
    with_instances_joined,
    with_objects_joined,
)
from more2_jax.tracking.regrouped import Regrouped
from more2_jax.tracking.split_masks import Balls

# Chosen on rooms of regime `real`, docs/developing/notebook/mask_parts.md.
SMOOTH = float(np.cos(np.deg2rad(30)))  # between normals of neighbors across a border
LEAST_SMOOTH = 0.7  # share of the border that must be smooth
FEWEST = 5  # points of a border


def join_smooth(whole: Regrouped, compared: Comparison) -> Regrouped | None:
    """Joins what is left over, of either scan, where it goes on smoothly; None of none.

    Objects only where they were seen once, in the same scan: two parts of one mask.
    """
    once = [k for k in compared.identified.gone if len(whole.objects[k].observations) == 1]
    scan = max((whole.objects[k].observations[0].scan for k in once), default=0)
    gone = [k for k in once if whole.objects[k].observations[0].scan == scan]
    row = {o.id: k for k, o in enumerate(whole.objects)}
    halves = [(r.object, r.divided or "") for r in whole.repairs]
    divided = [(row[a], row[b]) for a, b in halves if a in row and b in row]
    of_objects = smooth_joins(gone, [o.points for o in compared.old], divided)
    of_instances = smooth_joins(list(compared.identified.new), [o.points for o in compared.new], whole.halves)
    if not of_objects and not of_instances:
        return None
    joined = with_objects_joined(whole, of_objects, compared.prior)
    return with_instances_joined(joined, of_instances, compared.prior)


def smooth_joins(
    rows: Sequence[int], clouds: Sequence[Points], apart: Sequence[tuple[int, int]] = ()
) -> list[Join]:
    """Which of the clouds of one scan, by rows, go on in one another; the smoothest first, every cloud once.

    Not those that are known to be `apart`: halves of a mask that was divided.
    """
    rows, found = sorted(rows), list[Join]()
    balls = Balls.around([clouds[row] for row in rows])
    for n, m in combinations(range(len(rows)), 2):
        known_apart = {rows[n], rows[m]} in [set(pair) for pair in apart]
        near = not known_apart and m in balls.reach(clouds[rows[n]])
        if near and touch(clouds[rows[n]], clouds[rows[m]]):
            share = smooth_share(clouds[rows[n]], clouds[rows[m]])
            if share >= LEAST_SMOOTH:
                found.append(Join(matched=rows[n], part=rows[m], share=1.0, odds=0.0, smooth=share))
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
