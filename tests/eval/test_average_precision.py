"""Average precision: against values worked out by hand, and the laws that it keeps."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from eval.scores.average_precision import ap_of_rows, ap_rows

EYE = np.eye(3)


def average_precision(scores, iou, threshold=0.5):
    """At one threshold."""
    return ap_of_rows(np.array(ap_rows(scores, iou, (threshold,)), float).reshape(-1, 2))


def test_every_instance_found_is_one():
    assert average_precision(np.array([0.2, 0.9, 0.5]), 0.5 * EYE, 0.5) == 1.0


def test_by_hand():
    """Right, wrong, right, missed: precision 1 up to recall 1/3, then 2/3 up to 2/3."""
    iou = np.array([[0.8, 0.0, 0.0], [0.4, 0.3, 0.0], [0.0, 0.6, 0.1]])
    expected = 1 / 3 * 1 + 1 / 3 * 2 / 3
    assert average_precision(np.array([0.9, 0.8, 0.7]), iou, 0.5) == pytest.approx(expected, abs=1e-12)


def test_precision_is_the_best_from_a_recall_on():
    """Wrong, right, right: at every recall the best precision still to come is 2/3."""
    iou = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    assert average_precision(np.array([3.0, 2.0, 1.0]), iou) == pytest.approx(2 / 3, abs=1e-12)


def test_a_second_prediction_of_one_instance_is_wrong():
    """Right, wrong (claimed already), right: 1/2 · 1 + 1/2 · 2/3."""
    iou = np.array([[0.9, 0.0], [0.8, 0.0], [0.0, 0.7]])
    assert average_precision(np.array([3.0, 2.0, 1.0]), iou) == pytest.approx(5 / 6, abs=1e-12)


def test_what_is_claimed_leaves_the_next_best():
    """At a low threshold, the second prediction takes the instance that the first left."""
    iou = np.array([[0.9, 0.0], [0.5, 0.3]])
    assert average_precision(np.array([2.0, 1.0]), iou, 0.25) == 1.0
    assert average_precision(np.array([2.0, 1.0]), iou, 0.35) == 0.5


def test_equal_scores_enter_at_once():
    """One right and one wrong of the same score: precision 1/2 at recall 1, in either order."""
    for iou in ([[1.0], [0.0]], [[0.0], [1.0]]):
        assert average_precision(np.array([0.7, 0.7]), np.array(iou)) == 0.5


def test_order_does_not_matter():
    rng = np.random.default_rng(0)
    scores, iou = rng.integers(0, 4, 12).astype(float), rng.uniform(size=(12, 5))
    expected = average_precision(scores, iou, 0.6)
    assert 0 < expected < 1
    for _ in range(5):
        rows, columns = rng.permutation(12), rng.permutation(5)
        assert average_precision(scores[rows], iou[rows][:, columns], 0.6) == expected


def test_only_the_order_of_scores_counts():
    rng = np.random.default_rng(1)
    scores, iou = rng.normal(size=8), rng.uniform(size=(8, 4))
    assert average_precision(np.exp(scores), iou) == average_precision(scores, iou)


def test_scans_are_pooled_by_blocks():
    """A scan without predictions adds what was missed; one without instances adds what is wrong."""
    missed, wrong = np.zeros((0, 2)), np.zeros((1, 0))
    iou = block_diag(EYE, missed, wrong)
    expected = 3 / 5 * 3 / 4  # the wrong one has the greatest score
    assert average_precision(np.array([0.3, 0.2, 0.1, 0.9]), iou) == pytest.approx(expected, abs=1e-12)


def test_nothing_said_and_nothing_there():
    assert average_precision(np.zeros(0), np.zeros((0, 3))) == 0.0
    assert np.isnan(average_precision(np.array([0.5]), np.zeros((1, 0))))


def test_refuses_what_does_not_agree():
    with pytest.raises(ValueError, match="needed \\(2, g\\)"):
        average_precision(np.zeros(2), np.zeros((3, 1)))
    with pytest.raises(ValueError, match="not finite"):
        average_precision(np.array([np.nan]), np.ones((1, 1)))
