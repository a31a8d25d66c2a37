"""Average precision of objects followed over scans, as ReScene4D (arXiv 2601.11508) measures it: t-mAP.

A track is right where it is right in every scan. What is defined there, and what is our reading:
docs/concepts/measures.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from eval.data.truth import KnownScene
from eval.scores.average_precision import ap_rows
from eval.scores.figures import Record
from eval.scores.tracks import Track
from more2_jax.geometry.poses import Points

THRESHOLDS = tuple(np.linspace(0.5, 0.95, 10).tolist())  # of mAP, as ScanNet's benchmark has it
SAME_M = 1e-6  # poses take points away and back to within less; scans have theirs at 1e-4

Masks = Mapping[int, Bool[np.ndarray, " n"]]  # by scan, which of its points are one object's


def temporal_records(scene: KnownScene, tracks: Sequence[Track]) -> Record:
    """`t_map`, `t_ap50` and `ap50`, each a scene's `ap_rows`; nothing where the true masks are not known."""
    true = scene.true_masks()
    if true is None:
        return {}
    predicted, truths = masks_of(scene, tracks, true)
    copies = [o.copies for o in scene.objects]
    scores = np.array([t.score for t in tracks], float)
    every, pooled = overlaps(predicted, truths, copies)
    return {
        "t_map": ap_rows(scores, every, THRESHOLDS),
        "t_ap50": ap_rows(scores, every, THRESHOLDS[:1]),
        "ap50": ap_rows(scores, pooled, THRESHOLDS[:1]),
    }


def overlaps(
    predicted: Sequence[Masks], truths: Sequence[Masks], copies: Sequence[str]
) -> tuple[Float[np.ndarray, "p g"], Float[np.ndarray, "p g"]]:
    """Intersection over union of tracks and true objects: the least of all scans, and that of all scans together.

    Scans that neither has do not count; one that only one of them has makes the least 0. Objects with equal `copies`
    are interchangeable: in a scan that both have, the track is compared with the copy there that it overlaps most.
    """
    shape = len(predicted), len(truths)
    if 0 in shape:
        return np.zeros(shape), np.zeros(shape)
    same = np.array([[a == b for b in copies] for a in copies])
    least, both, either = np.full(shape, np.inf), np.zeros(shape), np.zeros(shape)
    rows, own = np.indices(shape)
    for k in sorted({k for masks in (*predicted, *truths) for k in masks}):
        a, b = np.split(stacked([*predicted, *truths], k), [shape[0]])
        of_a, of_b = a.sum(axis=1), b.sum(axis=1)
        common = a @ b.T
        iou = common / np.maximum(of_a[:, None] + of_b - common, 1)
        among = np.where(same, iou[:, None], 0.0)  # (p, g, copy of g)
        swapped = (of_b > 0) & (among.max(axis=2) > iou)
        shown = np.where(swapped, among.argmax(axis=2), own)
        there = (of_a[:, None] > 0) | (of_b > 0)
        least = np.where(there, np.minimum(least, iou[rows, shown]), least)
        both += common[rows, shown]
        either += of_a[:, None] + of_b[shown] - common[rows, shown]
    return np.where(np.isfinite(least), least, 0.0), both / np.maximum(either, 1)


def stacked(masks: Sequence[Masks], scan: int) -> Float[np.ndarray, "m n"]:
    """The masks of one scan as rows of 0 and 1; 0 throughout for those that do not have it."""
    none = np.zeros_like(next(m[scan] for m in masks if scan in m))
    return np.array([m.get(scan, none) for m in masks], float)


def masks_of(
    scene: KnownScene, tracks: Sequence[Track], true: Sequence[Mapping[str, Points]]
) -> tuple[list[dict[int, np.ndarray]], list[dict[int, np.ndarray]]]:
    """Tracks and true objects as masks over the points of every scan; points at one place are one point."""
    predicted: list[dict[int, np.ndarray]] = [{} for _ in tracks]
    truths: list[dict[int, np.ndarray]] = [{} for _ in scene.objects]
    for k, scan in enumerate(scene.scans):
        clouds = [*(i.points for i in scan.instances), scan.background, *true[k].values()]
        places = np.unique(np.concatenate(clouds), axis=0) if clouds else np.zeros((0, 3))
        tree = KDTree(places)
        for track, masks in zip(tracks, predicted, strict=True):
            if k in track.instance:
                own = track.seen.get(k)
                masks[k] = mask_of(tree, scene.instance(k, track.instance[k]).points if own is None else own)
        for o, masks in zip(scene.objects, truths, strict=True):
            if o.name in true[k]:
                masks[k] = mask_of(tree, true[k][o.name])
    return predicted, truths


def mask_of(tree: KDTree, points: Points) -> Bool[np.ndarray, " n"]:
    """Which of a scan's points these are. Raises ValueError for points that the scan does not have."""
    distance, row = tree.query(points)
    if off := int((distance > SAME_M).sum()):
        raise ValueError(
            f"{off} of a track's {len(points)} points are not of its scan; needed points of the scan"
        )
    mask = np.zeros(tree.n, bool)
    mask[row] = True
    return mask
