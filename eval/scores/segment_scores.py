"""Scores of instances found without classes, against the object that every point belongs to.

A prediction that overlaps an object which is not asked for (one that did not move) is left out, as COCO leaves out what
lies on regions to ignore: neither right nor wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Integer
from scipy.linalg import block_diag

from eval.scores.average_precision import average_precision

IOU = 0.5


@dataclass(frozen=True, kw_only=True)
class Overlaps:
    """Instances found in one scan, against its objects."""

    iou: Float[np.ndarray, "p g"]
    scores: Float[np.ndarray, " p"]
    moved: Bool[np.ndarray, " g"]  # between the scans
    unlabeled: Bool[np.ndarray, " p"]  # most of its points belong to no object of the truth


def overlaps(
    instance: Integer[np.ndarray, " n"],
    scores: Float[np.ndarray, " k"],
    owner: Integer[np.ndarray, " n"],
    moved: Bool[np.ndarray, " o"],
    least_points: int,
) -> Overlaps:
    """Of instances 1 to k (0: none) and owners 0 to o − 1 (−1: none); what has fewer points is left out."""
    both = np.zeros((len(scores) + 1, len(moved) + 1), np.int64)
    np.add.at(both, (instance, owner + 1), 1)
    of_instance, of_owner = both.sum(axis=1)[1:], both.sum(axis=0)[1:]
    union = of_instance[:, None] + of_owner - both[1:, 1:]
    rows, columns = of_instance >= least_points, of_owner >= least_points
    return Overlaps(
        iou=(both[1:, 1:] / np.maximum(union, 1))[rows][:, columns],
        scores=scores[rows],
        moved=moved[columns],
        unlabeled=(both[1:, 0] > of_instance / 2)[rows],
    )


def segment_scores(scans: Sequence[Overlaps]) -> dict[str, float]:
    """AP and recall at IoU 0.5 over the instances of all scans together, of all objects and of those that moved.

    `… labeled`: without predictions that lie mostly on what the truth does not label, which may be things too. Scores
    rank what is said to have moved; among all objects every prediction counts the same. NaN without such an object.
    """
    iou = np.asarray(block_diag(*(s.iou for s in scans)))
    scores = np.concatenate([s.scores for s in scans])
    moved = np.concatenate([s.moved for s in scans])
    labeled = ~np.concatenate([s.unlabeled for s in scans])
    on_static = iou[:, ~moved].max(axis=1, initial=0.0) >= IOU
    found = iou.max(axis=0, initial=0.0) >= IOU
    equal = np.ones(len(scores))
    return {
        "objects": float(len(moved)),
        "objects moved": float(moved.sum()),
        "instances": float(len(scores)),
        "instances unlabeled": float((~labeled).sum()),
        "AP50": average_precision(equal, iou, IOU),
        "AP50 labeled": average_precision(equal[labeled], iou[labeled], IOU),
        "AP50 moved": average_precision(scores[~on_static], iou[~on_static][:, moved], IOU),
        "AP50 moved labeled": average_precision(
            scores[~on_static & labeled], iou[~on_static & labeled][:, moved], IOU
        ),
        "AP50 moved, static wrong": average_precision(scores, iou[:, moved], IOU),
        "recall": _mean(found),
        "recall moved": _mean(found[moved]),
    }


def _mean(of: Bool[np.ndarray, " n"]) -> float:
    return float(of.mean()) if len(of) else float("nan")
