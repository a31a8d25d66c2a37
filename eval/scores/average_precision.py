"""Average precision of instances: the area under the curve of precision over recall."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float


def ap_rows(
    scores: Float[np.ndarray, " p"], iou: Float[np.ndarray, "p g"], thresholds: Sequence[float]
) -> list[list[float | None]]:
    """A scene's part of an average precision of `p` predictions against `g` true instances, over several thresholds of
    intersection over union: `[score, right or not at each threshold]` of a prediction, `[None, 0, …]` of an instance.

    Predictions claim in the order of falling score, each the free instance that it overlaps most, if by the threshold
    or more; one that claims none is a false positive. Of equal scores, the one that overlaps most claims first. Rows of
    scenes are put together one after the other. Raises ValueError for shapes that do not agree, and for scores that
    are not finite.
    """
    if iou.shape[:1] != scores.shape:
        raise ValueError(
            f"iou has shape {iou.shape}; needed ({len(scores)}, g), a row for each of the {len(scores)} scores"
        )
    if not np.isfinite(scores).all():
        raise ValueError("scores has entries that are not finite; needed finite scores")
    right = np.array([claimed(scores, iou, t) for t in thresholds], float).T
    predicted = [[float(s), *row.tolist()] for s, row in zip(scores, right, strict=True)]
    return [*predicted, *([None, *[0.0] * len(thresholds)] for _ in range(iou.shape[1]))]


def ap_of_rows(rows: Float[np.ndarray, "n _"]) -> float:
    """Mean average precision over the thresholds of `ap_rows`, with NaN for None; NaN without true instances."""
    true = np.isnan(rows[:, 0])
    if not true.any():
        return float("nan")
    scores, right = rows[~true, 0], rows[~true, 1:] > 0
    return float(np.mean([area(scores, column, int(true.sum())) for column in right.T]))


def area(scores: Float[np.ndarray, " p"], right: Bool[np.ndarray, " p"], count: int) -> float:
    """The area under the curve of precision over recall of `p` predictions, right or wrong, of `count` instances.

    Predictions of equal scores enter at once, so that their order does not matter. Precision at a recall is the best at
    that recall or a greater one (PASCAL VOC from 2010, COCO before its sampling at 101 recalls).
    """
    if not len(scores):
        return 0.0
    order = np.argsort(-scores, kind="stable")
    last = np.append(np.flatnonzero(np.diff(scores[order])), len(scores) - 1)  # of each distinct score
    true = np.cumsum(right[order])[last]
    recall, precision = true / count, true / (last + 1)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.diff(recall, prepend=0.0) @ best)


def claimed(
    scores: Float[np.ndarray, " p"], iou: Float[np.ndarray, "p g"], threshold: float
) -> Bool[np.ndarray, " p"]:
    """Whether each prediction is right, in the order given; they claim in that of falling score."""
    right = np.zeros(len(scores), bool)
    if iou.size:
        order = np.lexsort((-iou.max(axis=1), -scores))
        right[order] = claims(iou[order], threshold)
    return right


def claims(iou: Float[np.ndarray, "p g"], threshold: float) -> Bool[np.ndarray, " p"]:
    """Whether each prediction, in the order given, claims an instance that none before it has claimed."""
    free = np.ones(iou.shape[1], bool)
    right = np.zeros(len(iou), bool)
    for k, row in enumerate(iou):
        best = int(np.argmax(np.where(free, row, -1.0)))
        if free[best] and row[best] >= threshold:
            right[k], free[best] = True, False
    return right
