"""Rows in calls of one size: the same as one row at a time, whatever their number, and one program for all."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from more2_jax.network import row_map
from more2_jax.network.row_map import chunked, chunked_at

SIZE = 4


def rows_of(count):
    rng = np.random.default_rng(count)
    return {"x": rng.normal(size=(count, 3)).astype(np.float32), "flag": rng.random(count) < 0.5}


def one(row):
    return {"square": row["x"] ** 2, "sum": jnp.where(row["flag"], row["x"].sum(), -1.0)}


@pytest.fixture
def program():
    return jax.jit(jax.vmap(one))


@pytest.mark.parametrize("count", [1, 3, 4, 5, 8, 11])
def test_any_number_of_rows_gives_what_one_row_at_a_time_gives(program, count):
    rows = rows_of(count)
    found = chunked(program, SIZE, rows)
    for k in range(count):
        expected = one(jax.tree.map(lambda x, k=k: x[k], rows))
        for name, value in expected.items():
            np.testing.assert_allclose(found[name][k], value, rtol=1e-6)
    assert all(isinstance(x, np.ndarray) and len(x) == count for x in jax.tree.leaves(found))


def test_rows_made_call_by_call_are_those_made_at_once(program):
    """Of objects that are part of many pairs no more are held than a call takes."""
    rows, asked = rows_of(5), []
    pairs = np.random.default_rng(1).integers(0, 5, 11)

    def taken(at):
        asked.append(len(at))
        return {k: v[pairs[at]] for k, v in rows.items()}

    found = chunked_at(program, SIZE, len(pairs), taken)
    for name, value in chunked(program, SIZE, {k: v[pairs] for k, v in rows.items()}).items():
        np.testing.assert_array_equal(found[name], value)
    assert asked == [SIZE] * 3


@pytest.mark.parametrize("cores", [1, 3])
def test_calls_side_by_side_are_in_order_and_of_one_program(program, monkeypatch, cores):
    monkeypatch.setattr(row_map, "_cores", lambda: cores)
    rows = rows_of(43)
    with jax.enable_x64(True):  # which JAX keeps by thread, as it does the precision of products
        rows = {"x": rows["x"].astype(np.float64), "flag": rows["flag"]}
        found = chunked(program, SIZE, rows)
    assert found["square"].dtype == np.float64
    np.testing.assert_array_equal(found["square"], rows["x"] ** 2)
    assert program._cache_size() == 1


def test_of_no_rows_there_is_nothing_in_the_shapes_of_one():
    def called(rows):
        return {"square": rows["x"] ** 2, "two": jnp.ones((len(rows["x"]), 2, 3), jnp.int32)}

    found = chunked(called, SIZE, rows_of(0))
    assert {k: (v.shape, v.dtype) for k, v in found.items()} == {
        "square": ((0, 3), np.float32),
        "two": ((0, 2, 3), np.int32),
    }


def test_the_number_of_rows_compiles_nothing_new(program):
    for count in range(1, 14):
        chunked(program, SIZE, rows_of(count))
    assert program._cache_size() == 1


def test_every_row_is_in_one_call_and_only_fillers_are_repeated():
    calls = []

    def watched(rows):
        calls.append(rows["x"][:, 0].tolist())
        return rows["x"]

    chunked(watched, SIZE, {"x": np.arange(6.0)[:, None]})
    assert calls == [[0, 1, 2, 3], [4, 5, 4, 4]]


@pytest.mark.parametrize("closed_over", [False, True])
def test_inside_a_larger_program_and_its_gradient_rows_go_in_one_call(program, closed_over):
    """Also where what is traced is not among the rows but closed over by the function."""
    rows = rows_of(6)

    def total(factor):
        if closed_over:
            found = chunked(lambda r: {k: factor * v for k, v in program(r).items()}, SIZE, rows)
        else:
            found = chunked(program, SIZE, rows | {"x": factor * rows["x"]})
        return found["square"].sum()

    expected = (rows["x"] ** 2).sum()
    order = 1 if closed_over else 2
    for value_and_grad in (jax.value_and_grad(total), jax.jit(jax.value_and_grad(total))):
        value, gradient = value_and_grad(jnp.float32(1.0))
        assert float(value) == pytest.approx(expected, rel=1e-5)
        assert float(gradient) == pytest.approx(order * expected, rel=1e-5)


def test_inside_a_compiled_program_rows_may_be_constants(program):
    rows = rows_of(6)
    found = jax.jit(lambda x: x + chunked(program, SIZE, rows)["sum"])(jnp.zeros(6))
    np.testing.assert_allclose(found, chunked(program, SIZE, rows)["sum"], rtol=1e-6)
