"""Scores of instances found without classes, against the object that every point belongs to.

A prediction that overlaps an object which is not asked for (one that did not move) is left out, as COCO leaves out what
lies on regions to ignore: neither right nor wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Integer

from eval.scores.average_precision import ap_rows
from eval.scores.figures import Figure, Record

IOU = 0.5
SEGMENT_FIGURES = (
    *(
        Figure(name=f"AP50, {name}", key=key, statistic="average_precision", unit="%", scale=100)
        for name, key in (
            ("moved", "moved"),
            ("moved, labeled", "moved_labeled"),
            ("all", "all"),
            ("all, labeled", "all_labeled"),
        )
    ),
    Figure(name="recall, moved", key="found_moved", statistic="mean", unit="%", scale=100),
    Figure(name="recall, all", key="found", statistic="mean", unit="%", scale=100),
)


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


def segment_records(scan: Overlaps) -> list[Record]:
    """What `SEGMENT_FIGURES` are made of: one record of all instances of a scan, and one for each object.

    `labeled`: without predictions that lie mostly on what the truth does not label, which may be things too. Scores
    rank what is said to have moved; among all objects every prediction counts the same.
    """
    iou, scores, labeled = scan.iou, scan.scores, ~scan.unlabeled
    equal, of_moved = np.ones(len(scores)), iou[:, scan.moved]
    counted = ~(iou[:, ~scan.moved].max(axis=1, initial=0.0) >= IOU)  # not on what stayed
    both = counted & labeled
    found = iou.max(axis=0, initial=0.0) >= IOU
    predicted = {
        "all": ap_rows(equal, iou, (IOU,)),
        "all_labeled": ap_rows(equal[labeled], iou[labeled], (IOU,)),
        "moved": ap_rows(scores[counted], of_moved[counted], (IOU,)),
        "moved_labeled": ap_rows(scores[both], of_moved[both], (IOU,)),
    }
    objects = [{"found": bool(f)} for f in found]
    return [predicted, *objects, *({"found_moved": bool(f)} for f in found[scan.moved])]
