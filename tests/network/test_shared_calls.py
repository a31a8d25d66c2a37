"""Rows of several scenes in one call: as alone, few calls, no scene waits for one that never asks."""

from __future__ import annotations

import threading
import time
from functools import partial

import numpy as np
import pytest

from more2_jax.network.row_map import chunked
from more2_jax.network.shared_calls import side_by_side

SIZE = 4


class Program:
    """Squares rows, and remembers how many a call had."""

    def __init__(self):
        self.calls = []

    def __call__(self, rows, power=2):
        self.calls.append(len(rows))
        return rows**power


def rows_of(scene, count):
    return 10.0 * scene + np.arange(float(count))


@pytest.mark.parametrize("at_once", [1, 2, 8])
@pytest.mark.parametrize("counts", [[1], [4], [1, 2, 3, 4, 5], [9, 1, 1, 1], [3] * 12, [0, 5]])
def test_every_scene_gets_its_own_rows(at_once, counts):
    program = Program()
    found = side_by_side(lambda s: chunked(program, SIZE, rows_of(s, counts[s])), range(len(counts)), at_once)
    for s, count in enumerate(counts):
        np.testing.assert_array_equal(found[s], rows_of(s, count) ** 2)
    assert {n for n in program.calls if n != SIZE} <= {1}  # 1: what tells the shapes of no rows


@pytest.mark.parametrize("at_once", [1, 2])
def test_calls_are_filled_with_rows_of_other_scenes(at_once):
    """One row of each of eight scenes: two full calls instead of eight filled up."""
    program = Program()
    side_by_side(lambda s: chunked(program, SIZE, rows_of(s, 1)), range(8), at_once)
    assert program.calls == [SIZE] * 2


def test_only_equal_settings_and_shapes_share_a_call():
    program = Program()

    def one(scene):
        rows = rows_of(scene, 1) if scene % 2 else rows_of(scene, 1)[:, None]
        return chunked(partial(program, power=2 + scene // 4), SIZE, rows)

    found = side_by_side(one, range(8), 2)
    assert [x.item() for x in found] == [(10.0 * s) ** (2 + s // 4) for s in range(8)]
    assert len(program.calls) == 4


def test_scenes_that_ask_nothing_hold_nobody_up():
    program = Program()

    def one(scene):
        if scene:
            time.sleep(0.02)
            return np.zeros(0)
        return chunked(program, SIZE, rows_of(0, 3))

    np.testing.assert_array_equal(side_by_side(one, range(4), 2)[0], [0.0, 1.0, 4.0])


def test_no_more_scenes_work_at_once_than_asked_for_and_no_more_are_held():
    working, held, most, lock = [0], [0], [0, 0], threading.Lock()
    program = Program()

    def one(scene):
        with lock:
            held[0] += 1
            most[1] = max(most[1], held[0])
        for _ in range(3):
            with lock:
                working[0] += 1
                most[0] = max(most[0], working[0])
            time.sleep(0.005)
            with lock:
                working[0] -= 1
            chunked(program, SIZE, rows_of(scene, 1))
        with lock:
            held[0] -= 1

    side_by_side(one, range(9), at_once=2, together=5)
    assert most == [2, 5]


def test_a_call_that_fails_is_told_to_all_who_have_rows_in_it_and_nobody_waits():
    def broken(rows):
        raise RuntimeError("out of memory")

    told = []

    def one(scene):
        try:
            return chunked(broken if scene < 2 else np.square, SIZE, rows_of(scene, 1))
        except RuntimeError as error:
            told.append(str(error))
            raise

    with pytest.raises(RuntimeError, match="out of memory"):
        side_by_side(one, range(4), 2)
    assert told == ["out of memory"] * 2


def test_bad_numbers_are_refused_and_no_scenes_are_none():
    assert side_by_side(len, []) == []
    with pytest.raises(ValueError, match="together 0"):
        side_by_side(len, [()], together=0)
