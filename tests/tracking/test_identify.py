"""Who is who among what is left over: what lies in one place, and in any orientation what is nearly as likely."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection

import numpy as np
import pytest

from more2_jax.config import preset
from more2_jax.matching.assignment import LogOdds, assign
from more2_jax.matching.candidates import AlignedPairs
from more2_jax.tracking import identify
from more2_jax.tracking.identify import LEFT_OVER, Found, Identified, with_left_over, without_standing
from more2_jax.types import Frame

FREE, UPRIGHT = preset("robust", upright=False), preset("robust", upright=True)


# Object 0 is instance 1. Objects 1 and 2 are left over, as are instances 0 and 2.
KNOWN = Identified(
    found=(Found(object=0, instance=1, score=0.9),),
    gone={1: 0.7, 2: 0.8},
    new={0: 0.6, 2: 0.9},
    aligned=object.__new__(AlignedPairs),
)


def losses(pairs: np.ndarray, standing: Collection[tuple[int, int]]) -> np.ndarray:
    """3 of each pair whose object still stands where it stood."""
    return np.array([3.0 * (tuple(pair) in standing) for pair in pairs.tolist()])


def told(
    monkeypatch: pytest.MonkeyPatch, matrix: list[list[float]], config=FREE, known=KNOWN, here=(), standing=()
) -> Identified:
    odds = LogOdds.of(np.array(matrix, float))
    lie_there = np.array([tuple(pair) in here for pair in odds.pairs.tolist()])
    monkeypatch.setattr(identify, "odds_of", lambda *_: odds)
    monkeypatch.setattr(identify, "in_place", lambda _, rows, __: rows & lie_there)
    monkeypatch.setattr(identify, "motion_odds", lambda *_: np.zeros(9))
    monkeypatch.setattr(identify, "distances_m", lambda *given: np.zeros(len(given[-1])))
    monkeypatch.setattr(identify, "lost_by_standing", lambda _, moved, *__: losses(moved, standing))
    return with_left_over(known, config)


def pairs(found: Identified) -> list[tuple[int, int]]:
    return [(f.object, f.instance) for f in found.found]


def test_what_is_left_over_is_one_object_a_little_below_even_odds(monkeypatch):
    found = told(monkeypatch, [[-4, 3, -4], [-LEFT_OVER / 2, 2, -4], [-4, -4, -2 * LEFT_OVER]])
    assert pairs(found) == [(0, 1), (1, 0)]
    assert set(found.gone) == {2} and set(found.new) == {2}
    low, high = sorted(f.score for f in found.found)
    assert low < 0.95 < high  # the probability says how doubtful it is


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


def test_what_still_stands_is_not_what_is_left_over_elsewhere(monkeypatch):
    near_even = [[-4, 3, -4], [-0.1, -4, -0.3], [-4, -4, -4]]
    found = told(monkeypatch, near_even, standing={(1, 0)})
    assert pairs(found) == [(0, 1), (1, 2)]  # the next best is as likely as ever
    assert found.lost == {(1, 0): 3.0}
    assert told(monkeypatch, near_even, standing={(1, 0), (1, 2)}) is KNOWN


def test_an_assignment_is_made_anew_until_nothing_in_it_still_stands():
    odds = LogOdds.of(np.array([[2.0, 1.5], [1.0, 0.8]]))
    asked = []

    def standing(moved: np.ndarray) -> np.ndarray:
        asked.extend(map(tuple, moved.tolist()))
        return losses(moved, {(0, 0), (0, 1)})

    found, lost = without_standing(lambda lost: assign(odds.less(lost)), standing)
    assert found.tolist() == [[1, 0]]
    assert lost == {(0, 0): 3.0, (0, 1): 3.0}
    assert len(asked) == len(set(asked))  # of none twice
    again, _ = without_standing(
        lambda lost: assign(odds.less(lost)), lambda moved: np.zeros(len(moved)), lost
    )
    assert again.tolist() == found.tolist()  # what was lost stays lost


def test_what_is_very_likely_moved_though_something_alike_stands_there():
    odds = LogOdds.of(np.array([[5.0]]))
    found, _ = without_standing(lambda lost: assign(odds.less(lost)), lambda moved: np.full(len(moved), 3.0))
    assert found.tolist() == [[0, 0]]
