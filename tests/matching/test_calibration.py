"""What probabilities are told, by log odds: laws that hold whatever the weights."""

import numpy as np
import pytest

from more2_jax.config import SurfaceSearch
from more2_jax.matching.calibration import even_odds, mended_probability, probability, told_probability

SEARCH = SurfaceSearch()
ODDS = np.linspace(-6.0, 9.0, 31)
THERE = np.zeros(31)  # nothing moved


@pytest.mark.parametrize("motion", ["upright", "free"])
def test_an_even_chance_is_where_it_is_said_to_be(motion):
    assert probability(np.array([even_odds(SEARCH, motion)]), SEARCH, motion) == 0.5


@pytest.mark.parametrize("motion", ["upright", "free"])
def test_what_was_taken_is_likelier_right_and_better_evidence_makes_it_surer(motion):
    any_pair, taken = (probability(ODDS, SEARCH, motion), told_probability(ODDS, THERE, SEARCH, motion))
    even = even_odds(SEARCH, motion)
    assert (taken[even >= ODDS] > any_pair[even >= ODDS]).all()
    assert (np.diff(taken) > 0).all() and ((taken > 0) & (taken < 1)).all()


@pytest.mark.parametrize("motion", ["upright", "free"])
def test_mended_masks_make_it_less_sure_and_change_no_order(motion):
    taken = told_probability(ODDS, THERE, SEARCH, motion)
    mended = np.array([mended_probability(float(p), motion) for p in taken])
    assert (mended < taken).all() and (np.diff(mended) > 0).all()


@pytest.mark.parametrize("motion", ["upright", "free"])
def test_what_moved_far_is_no_surer_than_what_moved_little(motion):
    far_m = np.linspace(0.0, 8.0, 31)
    told = told_probability(np.full(31, 2.0), far_m, SEARCH, motion)
    assert (np.diff(told) <= 0).all() and told[-1] == told[-2]  # in the end it is all the same
