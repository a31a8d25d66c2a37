"""Who is who among what is left over: what lies in one place, and in any orientation what is nearly as likely."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from more2_jax.config import preset
from more2_jax.matching.assignment import LogOdds
from more2_jax.matching.candidates import AlignedPairs
from more2_jax.tracking import identify
from more2_jax.tracking.identify import LEFT_OVER, Found, Identified, with_left_over
from more2_jax.types import Frame

FREE, UPRIGHT = preset("robust", upright=False), preset("robust", upright=True)


# Object 0 is instance 1. Objects 1 and 2 are left over, as are instances 0 and 2.
KNOWN = Identified(
    found=(Found(object=0, instance=1, score=0.9),),
    gone={1: 0.7, 2: 0.8},
    new={0: 0.6, 2: 0.9},
    aligned=object.__new__(AlignedPairs),
)


def told(
    monkeypatch: pytest.MonkeyPatch, matrix: list[list[float]], config=FREE, known=KNOWN, here=()
) -> Identified:
    odds = LogOdds.of(np.array(matrix, float))
    lie_there = np.array([tuple(pair) in here for pair in odds.pairs.tolist()])
    monkeypatch.setattr(identify, "odds_of", lambda *_: odds)
    monkeypatch.setattr(identify, "in_place", lambda _, rows, __: rows & lie_there)
    monkeypatch.setattr(identify, "motion_odds", lambda *_: np.zeros(9))
    return with_left_over(known, config)


def pairs(found: Identified) -> list[tuple[int, int]]:
    return [(f.object, f.instance) for f in found.found]


def test_what_is_left_over_is_one_object_a_little_below_even_odds(monkeypatch):
    found = told(monkeypatch, [[-4, 3, -4], [-LEFT_OVER / 2, 2, -4], [-4, -4, -2 * LEFT_OVER]])
    assert pairs(found) == [(0, 1), (1, 0)]
    assert set(found.gone) == {2} and set(found.new) == {2}
    low, high = sorted(f.score for f in found.found)
    assert low < 0.1 < high  # the probability says how doubtful it is


def test_the_best_assignment_of_what_is_left_over_is_taken(monkeypatch):
    found = told(monkeypatch, [[-4, 3, -4], [-0.1, -4, -0.3], [-0.2, -4, -4]])
    assert pairs(found) == [(0, 1), (1, 2), (2, 0)]
    assert not found.gone and not found.new


def test_what_was_found_stays_as_it_was_found(monkeypatch):
    found = told(monkeypatch, [[5, 3, 5], [-4, 5, -4], [-4, 5, -4]])
    assert pairs(found) == [(0, 1)]
    assert found is KNOWN


def test_upright_and_without_surfaces_nothing_changes(monkeypatch):
    likely = [[-4, 3, -4], [-0.1, -4, -4], [-4, -4, -0.1]]
    assert told(monkeypatch, likely, UPRIGHT) is KNOWN
    by_codes = dataclasses.replace(KNOWN, aligned=None)
    assert told(monkeypatch, likely, FREE, by_codes) is by_codes


@pytest.mark.parametrize("config", [FREE, UPRIGHT])
def test_what_lies_in_one_place_is_one_object_however_unlike(monkeypatch, config):
    unlikely = [[-9, 3, -9], [-9, -9, -9], [-9, -9, -8]]
    found = told(monkeypatch, unlikely, config, here={(1, 2)})
    assert pairs(found) == [(0, 1), (1, 2)]
    assert set(found.gone) == {2} and set(found.new) == {0}
    assert found.found[1].score > 0.9


@pytest.mark.parametrize("config", [FREE, UPRIGHT])
def test_what_was_found_is_not_taken_from_what_lies_in_its_place(monkeypatch, config):
    assert told(monkeypatch, [[-9, 3, -9]] * 3, config, here={(1, 1), (0, 0)}) is KNOWN


def test_where_nothing_tells_how_a_scan_lies_places_say_nothing(monkeypatch):
    lost = dataclasses.replace(KNOWN, frame=Frame(unknown=True))
    assert told(monkeypatch, [[-9, 3, -9]] * 3, UPRIGHT, lost, here={(1, 2)}) is lost
