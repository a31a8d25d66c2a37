"""Masks that cut one object in two in both scans, each elsewhere: joined in both.

Beyond the paper, which takes masks as true. No mask shows the whole, so that `joined_masks` finds nothing to join by:
each part of one scan is found to be a part of the other. But one motion lays both parts of one scan onto both of the
other, and some of a part then lies on the part that it was not found to be. Of two things that stand side by side each
lies on itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from more2_jax.geometry.poses import Points, Pose, apply_pose
from more2_jax.geometry.touching_surfaces import touch
from more2_jax.tracking.comparison import Comparison
from more2_jax.tracking.joined_masks import (
    Join,
    instances_together,
    objects_together,
    seen_with,
    with_instances_joined,
    with_objects_joined,
)
from more2_jax.tracking.regrouped import Regrouped
from more2_jax.tracking.split_masks import Balls, reach_m
from more2_jax.types import Instance, SceneObject

Pair = tuple[int, int]  # rows of an object and of an instance
# Objects, in the scene's frame, and instances, in the scan's.
Clouds = tuple[Sequence[Points], Sequence[Points]]

# Chosen on rooms of regimes `sparse` and `real`, docs/developing/notebook/mask_parts.md.
LEAST_ON = 0.35  # share of either part that must lie on both parts of the other scan, in one pose
LEAST_CROSSED = 0.12  # share of what lies there that must lie on the part which it was not found to be
MOST_LOSS = 1.7  # log odds that both together may lose against the likelier part


@dataclass(frozen=True, kw_only=True)
class Crossing:
    """Two pairs, an object and an instance each, that are one object. The first was found, the second perhaps not."""

    pairs: tuple[Pair, Pair]
    share: float  # of the part that lies least on the object
    odds: float  # of both together

    def join(self, side: int) -> Join:
        """What is to be joined of the objects (side 0) or of the instances (1)."""
        first, second = self.pairs
        return Join(matched=first[side], part=second[side], share=self.share, odds=self.odds)


def join_crossed(whole: Regrouped, compared: Comparison) -> Regrouped | None:
    """Joins what is one object in two parts in both scans; None if there is none."""
    chosen, taken = list[Crossing](), set[tuple[int, int]]()
    for c in sorted(crossings(whole, compared), key=lambda c: -c.odds):
        clouds = {(side, row) for pair in c.pairs for side, row in enumerate(pair)}
        if taken.isdisjoint(clouds):  # every cloud once
            chosen.append(c)
            taken |= clouds
    if not chosen:
        return None
    objects_joined = with_objects_joined(whole, [c.join(0) for c in chosen], compared.prior)
    return with_instances_joined(objects_joined, [c.join(1) for c in chosen], compared.prior)


def crossings(whole: Regrouped, compared: Comparison) -> Iterator[Crossing]:
    """All that may be joined."""
    odds = compared.odds_of_found(0)
    clouds = [o.points for o in compared.old], [o.points for o in compared.new]
    for first, second in side_by_side(whole, compared, clouds):
        poses = [compared.best_pose(*pair) for pair in (first, second) if pair[0] in odds]
        share = share_crossed((first, second), clouds, poses)
        if share is None:
            continue
        together = compared.odds_of_pair(
            objects_together(compared, whole.objects, first[0], second[0]),
            instances_together(compared, whole.instances, first[1], second[1]),
        )
        if together >= max(odds[k] for k, _ in (first, second) if k in odds) - MOST_LOSS:
            yield Crossing(pairs=(first, second), share=share, odds=together)


def side_by_side(whole: Regrouped, compared: Comparison, clouds: Clouds) -> Iterator[tuple[Pair, Pair]]:
    """A pair that was found, and another, or two clouds left over: those whose clouds touch in both scans."""
    found = [(f.object, f.instance) for f in compared.identified.found]
    partner = {k: [i] for k, i in found}
    left = sorted(set(range(len(clouds[1]))) - {i for _, i in found})
    balls = [Balls.around(side) for side in clouds]
    for k, i in found:
        beside = set(balls[1].reach(clouds[1][i])) - {i}
        for q in balls[0].reach(clouds[0][k]):
            others = [j for j in partner.get(q, left) if j in beside and alike(whole.instances, i, j)]
            if q == k or not others or not may_be_part(whole.objects, k, q):
                continue
            if q in partner and q < k and may_be_part(whole.objects, q, k):
                continue  # it was, the other way round
            if touch(clouds[0][k], clouds[0][q]):
                yield from (((k, i), (q, j)) for j in others if touch(clouds[1][i], clouds[1][j]))


def may_be_part(objects: Sequence[SceneObject], k: int, part: int) -> bool:
    """Whether an object may be a part of another by when both were seen, and what they are called."""
    return seen_with(objects[k], objects[part]) and alike(objects, k, part)


def alike(named: Sequence[SceneObject] | Sequence[Instance], one: int, other: int) -> bool:
    """Whether two of a scan are not called differently."""
    a, b = named[one].label, named[other].label
    return a is None or b is None or a == b


def share_crossed(pairs: tuple[Pair, Pair], clouds: Clouds, poses: Sequence[Pose]) -> float | None:
    """Of both instances, the share of the one that lies least on both objects, in the pose in which most of it does.

    None where that is too little, or where each instance lies on its own object alone. `poses`: of the pairs found.
    """
    parts = [clouds[0][k] for k, _ in pairs]
    both, of = np.concatenate(parts), np.repeat((0, 1), [len(p) for p in parts])
    tree, reach, best = KDTree(both), reach_m(both), (0.0, 0.0)
    for T_old_new in poses:
        shares, crossed, on = list[float](), 0, 0
        for own, (_, i) in enumerate(pairs):
            points = apply_pose(T_old_new, clouds[1][i])
            distance, nearest = tree.query(points, distance_upper_bound=reach)
            near = np.isfinite(distance)
            shares.append(float(near.mean()))
            crossed += int((of[np.asarray(nearest)[near]] != own).sum())
            on += int(near.sum())
        best = max(best, (min(shares), crossed / max(1, on)))
    return best[0] if best[0] >= LEAST_ON and best[1] >= LEAST_CROSSED else None
