"""How far pairs of clouds lie apart in meters, and (upright) what of them the other scan shows to be empty space.

Beyond the paper (`EvidenceMatcher`). What keeps two scans of one object apart (a sensor's noise, drift, the voxels of
fusion) is so many centimeters whatever the size of the object. And a mask that is cut or dirty changes what an object
has, not what its scan saw: points that the other cloud lacks speak against a pair only where the other scan looked and
found nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from more2_jax.geometry.poses import Points, apply_pose
from more2_jax.geometry.seen_space import SeenSpace
from more2_jax.registration.search import AlignableObject
from more2_jax.types import ObservedObject

APART_M = 0.08  # a point farther from the other cloud counts as this far; chosen as `seen_space.CELL_M`
# So many times the noise where scans have more than usual, and at most: docs/developing/notebook/scan_noise.md.
NOISES, MOST_APART_M = 4.0, 0.16

Samples = list[Float[np.ndarray, "_ 3"]]
Seen = tuple[SeenSpace, SeenSpace]  # of the scene so far, and of the new scan, each in its own frame


NOWHERE = np.zeros((0, 3))


def seen_in(
    old: Sequence[ObservedObject],
    new: Sequence[ObservedObject],
    scene: Points = NOWHERE,
    scan: Points = NOWHERE,
) -> Seen:
    """All that the scene so far shows (its objects and `scene`) and all that the new scan shows, upright."""
    return SeenSpace([scene, *(o.points for o in old)]), SeenSpace([scan, *(o.points for o in new)])


@dataclass(frozen=True, kw_only=True)
class MetricEvidence:
    """Of p pairs at k poses each; source: the new scan's instance, target: the scene's object."""

    apart: Float[
        np.ndarray, "p k 2"
    ]  # mean distances of source and target, shares of what truncates them (`apart_within`)
    contradicted: Float[
        np.ndarray, "p k"
    ]  # the larger of the shares of both that lie in the other's empty space


def metric_evidence(
    sides: tuple[Sequence[ObservedObject], Sequence[ObservedObject]],
    samples: tuple[Samples, Samples],
    pairs: Int[np.ndarray, "p 2"],
    T_old_new: Float[np.ndarray, "p k 4 4"],
    seen: Seen | None,
    apart_m: float = APART_M,
) -> MetricEvidence:
    """Compares samples of instances and objects with the other cloud and what lies around it, and with the other scan.

    `sides`, `samples`: of instances (new scan's frame), then of objects (scene's frame). `pairs`: rows of both.
    Without `seen` nothing is known to be empty. `apart_m` truncates distances.
    """
    apart = np.zeros((*T_old_new.shape[:2], 2))
    empty = np.zeros_like(apart)
    for way in (0, 1):
        others = pairs[:, 1 - way]
        order = np.argsort(others, kind="stable")  # by the other cloud: one search tree is held at a time
        for rows in np.split(order, np.flatnonzero(np.diff(others[order])) + 1):
            tree = KDTree(all_around(sides[1 - way][int(others[rows[0]])]))
            for n in rows.tolist():
                poses = T_old_new[n] if way == 0 else np.linalg.inv(T_old_new[n])
                moved = np.concatenate([apply_pose(T, samples[way][pairs[n, way]]) for T in poses])
                off = shares_off(tree, moved, apart_m)
                apart[n, :, way] = off.reshape(len(poses), -1).mean(axis=1)
                if seen is not None:
                    far = off == 1.0  # what lies near the other cloud lies near something that its scan saw
                    lies_empty = np.zeros(len(moved), bool)
                    lies_empty[far] = seen[way].empty(moved[far], APART_M)
                    empty[n, :, way] = lies_empty.reshape(len(poses), -1).mean(axis=1)
    return MetricEvidence(apart=apart, contradicted=empty.max(axis=-1))


def all_around(o: ObservedObject) -> Points:
    """An object's points and what lies around it: a mask may have lost what its scan still shows."""
    return o.points if o.around is None else np.concatenate([o.points, o.around])


def samples_of(ready: AlignableObject, origin: Float[np.ndarray, "b 3"]) -> Samples:
    """What the search compares of every object, in its scan's frame; float64. `origin`: of its local frame there."""
    points, mask = np.asarray(ready.coarse.sampled.points, np.float64), np.asarray(ready.coarse.sampled.mask)
    return [points[k][mask[k]] + origin[k] for k in range(len(points))]


def shares_off(tree: KDTree, points: Float[np.ndarray, "n 3"], apart_m: float) -> Float[np.ndarray, " n"]:
    """Distances of points from a cloud, truncated at `apart_m` and as shares of it."""
    nearest, _ = tree.query(points, distance_upper_bound=apart_m)
    return np.minimum(nearest / apart_m, 1.0)


def apart_within(noise_m: float) -> float:
    """What truncates distances of scans with so much noise, meters."""
    return min(max(APART_M, NOISES * noise_m), MOST_APART_M)
