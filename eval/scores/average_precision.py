"""Average precision of instances: the area under the curve of precision over recall."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float


def average_precision(
    scores: Float[np.ndarray, " p"], iou: Float[np.ndarray, "p g"], threshold: float = 0.5
) -> float:
    """AP of `p` predictions against `g` true instances at one threshold of intersection over union; NaN if g is 0.

    Predictions claim in the order of falling score, each the free instance that it overlaps most, if by `threshold`
    or more; one that claims none is a false positive. Of equal scores, the one that overlaps most claims first, and
    all enter the curve at once, so that their order does not matter. Precision at a recall is the best at that recall
    or a greater one (PASCAL VOC from 2010, COCO before its sampling at 101 recalls). Instances of several scans:
    `scipy.linalg.block_diag` of their matrices. Raises ValueError for shapes that do not agree, and for scores that
    are not finite.
    """
    if iou.shape[:1] != scores.shape:
        raise ValueError(
            f"iou has shape {iou.shape}; needed ({len(scores)}, g), a row for each of the {len(scores)} scores"
        )
    if not np.isfinite(scores).all():
        raise ValueError("scores has entries that are not finite; needed finite scores")
    if iou.shape[1] == 0:
        return float("nan")
    if not len(scores):
        return 0.0
    order = np.lexsort((-iou.max(axis=1), -scores))
    right = claims(iou[order], threshold)
    last = np.append(np.flatnonzero(np.diff(scores[order])), len(scores) - 1)  # of each distinct score
    true = np.cumsum(right)[last]
    recall, precision = true / iou.shape[1], true / (last + 1)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.diff(recall, prepend=0.0) @ best)


def claims(iou: Float[np.ndarray, "p g"], threshold: float) -> Bool[np.ndarray, " p"]:
    """Whether each prediction, in the order given, claims an instance that none before it has claimed."""
    free = np.ones(iou.shape[1], bool)
    right = np.zeros(len(iou), bool)
    for k, row in enumerate(iou):
        best = int(np.argmax(np.where(free, row, -1.0)))
        if free[best] and row[best] >= threshold:
            right[k], free[best] = True, False
    return right
