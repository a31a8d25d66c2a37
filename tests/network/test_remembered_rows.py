"""Rows are computed once while scans are compared again: with the results they would have, and within bounds."""

from __future__ import annotations

import numpy as np
import pytest

from more2_jax.network.remembered_rows import RememberedRows, once, only_new, rows_remembered

ROWS = {"a": np.arange(12.0).reshape(6, 2), "b": np.arange(6, dtype=np.int32)}


def squares(rows):
    return {"sum": (rows["a"] ** 2).sum(axis=1) + rows["b"], "pair": rows["a"] * 2}


class Counted:
    """`only_new` of some rows; how many were computed, call by call."""

    def __init__(self) -> None:
        self.counts: list[int] = []

    def of(self, rows, function=squares):
        def taken(at):
            return {name: x[at] for name, x in rows.items()}

        def computed(at):
            self.counts.append(len(at))
            return function(taken(at))

        return only_new(function, len(rows["b"]), taken, computed)


def same(found, wanted):
    assert found.keys() == wanted.keys()
    for name in wanted:
        np.testing.assert_array_equal(found[name], wanted[name])


def changed(rows, at, order):
    rows = {name: x[order].copy() for name, x in rows.items()}
    rows["a"][at] += 1
    return rows


def test_only_rows_that_changed_are_computed_anew_whatever_their_order():
    counted = Counted()
    with rows_remembered():
        same(counted.of(ROWS), squares(ROWS))
        other = changed(ROWS, [1, 4], [3, 0, 5, 5, 1, 2])
        same(counted.of(other), squares(other))
        same(counted.of(other), squares(other))
    assert counted.counts == [6, 2]


def test_what_equal_arrays_tell_is_computed_once():
    asked = []

    def doubled(x):
        asked.append(x)
        return 2 * x

    x = np.arange(3.0)
    with rows_remembered():
        for y in (x, x.copy(), x + 1, x):
            np.testing.assert_array_equal(once(doubled, (y,), y), 2 * y)
        assert len(asked) == 2
    once(doubled, (x,), x)
    assert len(asked) == 3  # nothing is remembered outside


def test_what_is_too_large_to_be_held_is_computed_again():
    x, asked = np.arange(3.0), []

    def doubled(x):
        asked.append(x)
        return 2 * x

    with rows_remembered() as programs:
        programs.most_bytes = x.nbytes - 1
        for _ in range(2):
            np.testing.assert_array_equal(once(doubled, (x,), x), 2 * x)
    assert len(asked) == 2


def test_a_row_that_differs_in_one_bit_is_another_row():
    counted, other = Counted(), {name: x.copy() for name, x in ROWS.items()}
    other["a"][2, 0] = np.nextafter(other["a"][2, 0], 9.0)
    with rows_remembered():
        counted.of(ROWS)
        same(counted.of(other), squares(other))
    assert counted.counts == [6, 1]


def test_nothing_is_remembered_outside_or_of_another_function():
    counted = Counted()
    counted.of(ROWS)
    counted.of(ROWS)
    with rows_remembered():
        counted.of(ROWS)
        same(counted.of(ROWS, cubes), cubes(ROWS))
    with rows_remembered():
        counted.of(ROWS)
    assert counted.counts == [6, 6, 6, 6, 6]


def cubes(rows):
    return {"sum": rows["b"] ** 3.0}


def test_no_rows_are_no_rows():
    counted = Counted()
    none = {name: x[:0] for name, x in ROWS.items()}
    with rows_remembered():
        same(counted.of(none), squares(none))


def test_results_are_copies_that_nobody_changes():
    counted = Counted()
    with rows_remembered():
        first = counted.of(ROWS)
        first["sum"][:] = -1
        same(counted.of(ROWS), squares(ROWS))


@pytest.mark.parametrize("most", [0, 100, 1000])
def test_no_more_is_held_than_allowed_and_the_newest_stays(most):
    memory = RememberedRows(most_bytes=most)
    for n in range(20):
        memory.keep(n, np.zeros(5))  # 40 bytes
        assert memory.size_bytes == sum(x.nbytes for x in memory.found.values()) <= most
    assert list(memory.found) == list(range(20))[20 - min(20, most // 40) :]


def test_a_row_given_up_is_computed_again_with_the_same_result():
    counted = Counted()
    with rows_remembered() as programs:
        programs.most_bytes = 60  # of two rows, 24 bytes each
        same(counted.of(ROWS), squares(ROWS))
        same(counted.of(ROWS), squares(ROWS))
    assert counted.counts == [6, 4]


def test_results_of_one_program_do_not_push_out_those_of_another():
    counted = Counted()
    with rows_remembered() as programs:
        programs.most_bytes = 6 * 24
        counted.of(ROWS)
        for n in range(5):
            counted.of(ROWS | {"a": ROWS["a"] + 100 * n}, cubes)
        same(counted.of(ROWS), squares(ROWS))
    assert len(programs.rows) == 2
    assert counted.counts == [6] * 6
