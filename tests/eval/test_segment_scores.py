"""Scores of instances without classes: overlaps by hand, and what counts neither way."""

import numpy as np
import pytest

from eval.scores.figures import rows_of
from eval.scores.segment_scores import SEGMENT_FIGURES, overlaps, segment_records

OWNER = np.repeat([0, 1, 2, -1], [10, 10, 3, 10])  # 2 has too few points
MOVED = np.array([True, False, True])


def segment_scores(scans, field="value"):
    """The figures of one room's scans, by name."""
    records = [{"method": "", **r} for scan in scans for r in segment_records(scan)]
    return {r.name: getattr(r, field) for r in rows_of(SEGMENT_FIGURES, {"room": records})}


def test_overlaps_by_hand():
    instance = np.repeat([1, 2, 0, 3, 4], [8, 2, 13, 9, 1])
    instance[10:18] = 2
    found = overlaps(instance, np.array([0.9, 0.8, 0.7, 0.6]), OWNER, MOVED, 4)
    assert found.iou == pytest.approx(np.array([[8 / 10, 0], [2 / 18, 8 / 12], [0, 0]]))
    assert found.scores.tolist() == [0.9, 0.8, 0.7]
    assert found.moved.tolist() == [True, False]
    assert found.unlabeled.tolist() == [False, False, True]


def test_the_truth_itself_is_perfect():
    scans = [overlaps(OWNER + 1, np.ones(3), OWNER, MOVED, 4)] * 2
    assert list(segment_scores(scans).values()) == [100.0] * len(SEGMENT_FIGURES)
    counts = segment_scores(scans, "count")
    assert (counts["AP50, all"], counts["recall, all"]) == (4, 4)
    assert (counts["AP50, moved"], counts["recall, moved"]) == (2, 2)


def test_what_stayed_is_neither_right_nor_wrong_among_the_moved():
    instance = np.where(OWNER == 0, 1, np.where(OWNER == 1, 2, 0))
    scores = segment_scores([overlaps(instance, np.array([0.1, 0.9]), OWNER, MOVED, 4)])
    assert scores["AP50, moved"] == 100.0
    assert scores["AP50, all"] == 100.0
    assert scores["recall, moved"] == 100.0


def test_what_is_empty_counts_against_the_moved():
    """The greatest score is on what no object owns: one right, one wrong before it."""
    instance = np.where(OWNER == 0, 1, np.where(OWNER < 0, 2, 0))
    scores = segment_scores([overlaps(instance, np.array([0.1, 0.9]), OWNER, MOVED, 4)])
    assert scores["AP50, moved"] == 50.0
    assert scores["recall, all"] == 50.0


def test_what_lies_on_unlabeled_points_is_left_out_where_said():
    instance = np.where(OWNER < 0, 1, np.where(OWNER == 0, 2, np.where(OWNER == 1, 3, 0)))
    scores = segment_scores([overlaps(instance, np.array([0.9, 0.5, 0.5]), OWNER, MOVED, 4)])
    assert scores["AP50, moved, labeled"] == 100.0
    assert scores["AP50, moved"] == 50.0
    assert scores["AP50, all"] == pytest.approx(200 / 3)
    assert scores["AP50, all, labeled"] == 100.0


def test_nothing_found():
    scores = segment_scores([overlaps(0 * OWNER, np.zeros(0), OWNER, MOVED, 4)])
    assert set(scores.values()) == {0.0}
