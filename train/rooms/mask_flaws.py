"""Masks as a network predicts them: cut short, dirty, split, two objects in one, or none.

An instance belongs to the object that most of its points truly show; damage is drawn object by object.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

Flaw = Literal["perfect", "cut", "dirty", "split", "merged", "missed"]
Masks = Literal["perfect", "cut", "dirty", "split", "merged", "missed", "mix"]
MASKS: tuple[Masks, ...] = get_args(Masks)
MIX: dict[Flaw, float] = {"perfect": 0.35, "cut": 0.2, "dirty": 0.2, "split": 0.15, "merged": 0.1}
LOST = (0.25, 0.5)  # share of a cut mask's points that are gone
FOREIGN = (0.1, 0.3)  # share of a dirty mask's points that are another's or nobody's
REACH_M = 0.25  # such points lie at most so far from the object
SMALLER = (0.2, 0.5)  # share of a split object's points in its smaller part
MISSED = 0.25  # share of objects that get no mask where masks are missed
TOUCHING_M = 1.0  # objects further apart are never merged
FEWEST = 64  # points of an instance: smaller ones are not predicted


def draw_flaws(count: int, masks: Masks, rng: np.random.Generator) -> list[Flaw]:
    """The flaw of each object of a scan; at most one merges."""
    if masks == "missed":
        flaws: list[Flaw] = ["missed" if x < MISSED else "perfect" for x in rng.random(count)]
    elif masks != "mix":
        flaws = [masks] * count
    else:
        names, shares = list(MIX), list(MIX.values())
        flaws = [names[k] for k in rng.choice(len(names), count, p=shares)]
    merging = [k for k, f in enumerate(flaws) if f == "merged"]
    kept = int(rng.choice(merging)) if merging else -1
    return ["perfect" if f == "merged" and k != kept else f for k, f in enumerate(flaws)]


def predicted_masks(
    points: Float[np.ndarray, "v 3"],
    label: Int[np.ndarray, " v"],
    flaws: Mapping[int, Flaw],
    rng: np.random.Generator,
) -> Int[np.ndarray, " v"]:
    """The instance of every point (from 1, in any order; 0: none), of the label that each has (−1: none).

    Objects are dirtied before any is cut, split or merged, so that no one's damage repairs another's. Instances of
    fewer than `FEWEST` points are none.
    """
    mask = np.where(np.isin(label, [k for k, f in flaws.items() if f == "missed"]), 0, label + 1)
    for flaw, change in (("dirty", _dirty), ("cut", _cut), ("split", _split), ("merged", _merged)):
        for k in (k for k, f in flaws.items() if f == flaw):
            if (mask == k + 1).sum() >= FEWEST:
                mask = change(points, mask, k + 1, rng)
    return _numbered(mask, rng)


def _numbered(mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Ids from 1 that say nothing from scan to scan."""
    ids, count = np.unique(mask, return_counts=True)
    kept = [i for i, n in zip(ids.tolist(), count.tolist(), strict=True) if i > 0 and n >= FEWEST]
    numbers = np.zeros(max(ids.max(), 0) + 1, np.int64)
    numbers[np.array(kept, np.int64)] = rng.permutation(len(kept)) + 1
    return numbers[np.maximum(mask, 0)]


def _cut(points: np.ndarray, mask: np.ndarray, own: int, rng: np.random.Generator) -> np.ndarray:
    """A half-space, or the outermost band, of an object's points is lost."""
    mine = np.flatnonzero(mask == own)
    place = points[mine] - np.median(points[mine], axis=0)
    far = np.linalg.norm(place, axis=1) if rng.random() < 0.5 else place @ _any_direction(rng)
    lost = far > np.quantile(far, 1 - rng.uniform(*LOST))
    return _changed(mask, mine[lost], 0)


def _dirty(points: np.ndarray, mask: np.ndarray, own: int, rng: np.random.Generator) -> np.ndarray:
    """A patch of floor, wall or neighbors comes in: what lies nearest to the object and to one place of it."""
    mine, others = np.flatnonzero(mask == own), np.flatnonzero(mask != own)
    distance = KDTree(points[mine]).query(points[others], distance_upper_bound=REACH_M)[0]
    near, distance = others[np.isfinite(distance)], distance[np.isfinite(distance)]
    share = rng.uniform(*FOREIGN)
    wanted = round(share / (1 - share) * len(mine))
    middle = points[rng.choice(mine)]
    order = np.argsort(distance + 0.2 * np.linalg.norm(points[near] - middle, axis=1), kind="stable")
    return _changed(mask, near[order[:wanted]], own)


def _split(points: np.ndarray, mask: np.ndarray, own: int, rng: np.random.Generator) -> np.ndarray:
    """A plane across the direction of greatest spread, or nearly so, makes two of one."""
    mine = np.flatnonzero(mask == own)
    place = points[mine] - points[mine].mean(axis=0)
    main = np.linalg.eigh(place.T @ place)[1][:, -1]
    along = place @ (main * np.sign(main[np.abs(main).argmax()]) + 0.3 * _any_direction(rng))
    if rng.random() < 0.5:
        along = -along
    smaller = along > np.quantile(along, 1 - rng.uniform(*SMALLER))
    if min(smaller.sum(), (~smaller).sum()) < FEWEST:
        return mask
    return _changed(mask, mine[smaller], int(mask.max()) + 1)


def _merged(points: np.ndarray, mask: np.ndarray, own: int, rng: np.random.Generator) -> np.ndarray:
    """The object and its nearest neighbor share one mask, where they are near."""
    tree = KDTree(points[mask == own])
    others = [i for i in np.unique(mask[mask > 0]).tolist() if i != own]
    gaps = [float(tree.query(points[mask == i])[0].min()) for i in others]
    if not gaps or min(gaps) > TOUCHING_M:
        return mask
    return _changed(mask, np.flatnonzero(mask == own), others[int(np.argmin(gaps))])


def _changed(mask: np.ndarray, rows: np.ndarray, value: int) -> np.ndarray:
    changed = mask.copy()
    changed[rows] = value
    return changed


def _any_direction(rng: np.random.Generator) -> np.ndarray:
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)
