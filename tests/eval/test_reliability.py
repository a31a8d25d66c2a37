"""Reliability: bins by hand, and curves of probabilities that hold."""

import numpy as np
import pytest
from scipy.special import expit, logit

from eval.harness.plots import draw_reliability
from eval.scores.reliability import Bin, calibration_error, reliability

SAID = np.array([0.9, 0.92, 0.94, 0.98, 0.25, 0.27, 0.0])
TRUE = np.array([True, True, True, False, False, True, False])


def test_bins_by_hand():
    """What is said with 0 and 1 belongs to the first and the last bin; empty ones are left out."""
    odds = np.where(SAID > 0, logit(np.maximum(SAID, 1e-9)), -np.inf)
    found = reliability(odds + 1e-12, TRUE)
    expected = [
        Bin(low=0.0, high=0.1, said=0.0, true=0.0, count=1),
        Bin(low=0.2, high=0.3, said=0.26, true=0.5, count=2),
        Bin(low=0.9, high=1.0, said=0.935, true=0.75, count=4),
    ]
    assert [(b.low, b.count) for b in found] == [(b.low, b.count) for b in expected]
    for a, b in zip(found, expected, strict=True):
        assert (a.high, a.said, a.true) == pytest.approx((b.high, b.said, b.true), abs=1e-6)
    assert calibration_error(odds + 1e-12, TRUE) == pytest.approx((2 * 0.24 + 4 * 0.185) / 7, abs=1e-6)
    (sure,) = reliability(np.full(3, 800.0), np.array([True, True, False]))
    assert (sure.low, sure.said, sure.true, sure.count) == (0.9, 1.0, pytest.approx(2 / 3), 3)


def test_two_bins_by_hand():
    found = reliability(logit(np.array([0.4, 0.2, 0.8])), np.array([True, False, True]), bins=2)
    assert [(b.low, b.high, b.count) for b in found] == [(0.0, 0.5, 2), (0.5, 1.0, 1)]
    assert [b.said for b in found] == pytest.approx([0.3, 0.8]) and [b.true for b in found] == [0.5, 1.0]


def test_probabilities_that_hold_lie_on_the_diagonal_and_others_do_not():
    rng = np.random.default_rng(0)
    odds = rng.normal(scale=3, size=50_000)
    one = rng.random(50_000) < expit(odds)
    assert calibration_error(odds, one) < 0.01
    assert all(abs(b.said - b.true) < 0.03 for b in reliability(odds, one))
    assert calibration_error(2 * odds, one) > 0.05  # twice as sure as they should be


def test_a_plot_in_both_forms(tmp_path):
    pytest.importorskip("matplotlib")
    curves = {"m, shipped": reliability(logit(np.array([0.4, 0.2, 0.8])), np.array([True, False, True]))}
    files = draw_reliability(tmp_path / "reliability", curves)
    assert [f.name for f in files] == ["reliability.png", "reliability.svg"]
    assert files[0].read_bytes().startswith(b"\x89PNG") and "m, shipped (3)" in files[1].read_text()
