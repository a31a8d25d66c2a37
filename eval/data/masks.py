"""Masks that are not the true ones: damaged on purpose, or predicted; and which object each then shows."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from eval.data.truth import KnownScene
from more2_jax.types import Scan

Points = Float[np.ndarray, "n 3"]
Damage = Callable[[Scan, np.random.Generator], Scan]

LOST = -1  # the instance of an object that no mask shows
LEAST_OVERLAP = 0.25  # intersection over union, of a mask and the object it shows
CHANGED = 0.25  # share of a scan's objects that are merged or split
ERODED = 0.25  # share of an object's points, the outermost, that an eroded mask loses
WRONG = 0.2  # share of a mask's points that belong to something else


def with_masks(scene: KnownScene, damage: Damage, seed: int = 0) -> KnownScene:
    """The scene as it looks through damaged masks."""
    rng = np.random.default_rng((seed, *scene.name.encode()))
    return associated(scene, [damage(scan, rng) for scan in scene.scans])


def associated(scene: KnownScene, scans: Sequence[Scan]) -> KnownScene:
    """The scene with other masks of the same points: every object is shown by the mask that overlaps it most.

    An object of which no mask has `LEAST_OVERLAP` is `LOST`: it stays in all denominators.
    """
    shown = [best_masks(old, new) for old, new in zip(scene.scans, scans, strict=True)]
    objects = tuple(
        dataclasses.replace(o, instance={k: shown[k].get(i, LOST) for k, i in o.instance.items()}, parts={})
        for o in scene.objects
    )
    return dataclasses.replace(scene, scans=tuple(scans), objects=objects, true_points=scene.true_masks())


def best_masks(true: Scan, masks: Scan) -> dict[int, int]:
    """True instance → id of the mask that shows it: one to one, the greatest sum of overlaps."""
    if not true.instances or not masks.instances:
        return {}
    sets = [[_rows(i.points) for i in s.instances] for s in (true, masks)]
    overlap = np.array([[len(a & b) / len(a | b) for b in sets[1]] for a in sets[0]])
    rows, columns = linear_sum_assignment(-overlap)
    return {
        true.instances[r].id: masks.instances[c].id
        for r, c in zip(rows, columns, strict=True)
        if overlap[r, c] >= LEAST_OVERLAP
    }


def _rows(points: Points) -> set[bytes]:
    return set(map(bytes, np.ascontiguousarray(points, np.float64)))


def merged(scan: Scan, rng: np.random.Generator) -> Scan:
    """Some objects share the mask of the nearest other object."""
    instances = list(scan.instances)
    for _ in range(_some(scan)):
        if len(instances) < 2:
            break
        one = instances.pop(int(rng.integers(len(instances))))
        centers = np.stack([i.points.mean(axis=0) for i in instances])
        k = int(np.linalg.norm(centers - one.points.mean(axis=0), axis=1).argmin())
        both = np.concatenate([instances[k].points, one.points])
        instances[k] = dataclasses.replace(instances[k], points=both, colors=None, normals=None)
    return dataclasses.replace(scan, instances=tuple(instances))


def split(scan: Scan, rng: np.random.Generator) -> Scan:
    """Some objects fall into two masks, cut by a random plane through their middle."""
    cut = set(rng.choice(len(scan.instances), _some(scan), replace=False).tolist())
    instances, next_id = [], max((i.id for i in scan.instances), default=0) + 1
    for k, i in enumerate(scan.instances):
        if k not in cut:
            instances.append(i)
            continue
        direction = rng.normal(size=3)
        side = (i.points - np.median(i.points, axis=0)) @ direction > 0
        for id_, half in ((i.id, side), (next_id, ~side)):
            if half.any():
                instances.append(
                    dataclasses.replace(i, id=id_, points=i.points[half], colors=None, normals=None)
                )
        next_id += 1
    return dataclasses.replace(scan, instances=tuple(instances))


def eroded(scan: Scan, rng: np.random.Generator) -> Scan:
    """Every mask loses its outermost points to the background."""

    def inner(points: Points) -> Points:
        distance = np.linalg.norm(points - points.mean(axis=0), axis=1)
        return points[distance <= np.quantile(distance, 1 - ERODED)]

    return _each(scan, inner)


def wrong(scan: Scan, rng: np.random.Generator) -> Scan:
    """Of every mask's points, `WRONG` are the nearest ones of other objects and of the background instead.

    What a mask shows of others stays theirs too.
    """
    others = [i.points for i in scan.instances]

    def stained(points: Points) -> Points:
        rest = np.concatenate([*(p for p in others if p is not points), scan.background])
        count = int(WRONG * len(points))
        if not count or not len(rest):
            return points
        near = np.argsort(KDTree(points).query(rest)[0])[: 2 * count]
        kept = rng.permutation(len(points))[count:]
        return np.concatenate([points[np.sort(kept)], rest[rng.permutation(near)[:count]]])

    return _each(scan, stained)


def _some(scan: Scan) -> int:
    return max(1, round(CHANGED * len(scan.instances))) if scan.instances else 0


def _each(scan: Scan, change: Callable[[Points], Points]) -> Scan:
    """Every mask changed; the points it loses are still in the scan, as background."""
    instances, background = [], [scan.background]
    for i in scan.instances:
        points = change(i.points)
        kept = _rows(points)
        background.append(i.points[[bytes(row) not in kept for row in np.asarray(i.points, np.float64)]])
        instances.append(dataclasses.replace(i, points=points, colors=None, normals=None))
    return dataclasses.replace(scan, instances=tuple(instances), background=np.concatenate(background))


DAMAGES: dict[str, Damage] = {"merged": merged, "split": split, "eroded": eroded, "wrong": wrong}
