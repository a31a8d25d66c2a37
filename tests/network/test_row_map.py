"""Rows in turn give what rows at once give: values, gradients, and shared over devices."""

from __future__ import annotations

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from places import ROOT

from more2_jax.network.row_map import in_blocks, in_turn

ROWS = {"a": jax.random.normal(jax.random.key(0), (12, 5)), "b": jnp.arange(12.0)}


WEIGHT = jax.random.normal(jax.random.key(1), (5,))

ON_DEVICES = """
import sys
sys.path[:0] = sys.argv[1:]
import jax, numpy as np
from jax.sharding import Mesh
from test_row_map import ROWS, WEIGHT, loss, one
from more2_jax.network.row_map import in_turn

def close(x, y): np.testing.assert_allclose(x, y, rtol=1e-5)

for count, at_once in [(1, 4), (2, 3), (3, 2), (4, 3)]:
    mesh = Mesh(np.array(jax.devices()[:count]), ("some",))
    jax.tree.map(close, in_turn(one, WEIGHT, ROWS, at_once, mesh), jax.vmap(one, (None, 0))(WEIGHT, ROWS))
    found = jax.jit(jax.grad(lambda w: loss(w, lambda f, w: in_turn(f, w, ROWS, at_once, mesh))))(WEIGHT)
    close(found, jax.grad(lambda w: loss(w, lambda f, w: jax.vmap(f, (None, 0))(w, ROWS)))(WEIGHT))
try:
    in_turn(one, WEIGHT, {k: x[:10] for k, x in ROWS.items()}, 1, mesh)
except ValueError as error:
    assert "evenly divisible" in str(error)
else:
    raise AssertionError("10 rows on 4 devices")
print("held")
"""


def one(weight, row):
    return {"sum": jnp.sin(row["a"] @ weight) * row["b"], "row": row["a"] + row["b"]}


def loss(weight, over):
    found = over(one, weight)
    return (jnp.tanh(found["sum"]) ** 2).sum() + (found["row"] ** 2).sum()


@pytest.mark.parametrize("at_once", [1, 4, 5, 50])
def test_the_same_as_all_at_once(at_once):
    found, wanted = in_turn(one, WEIGHT, ROWS, at_once), jax.vmap(one, (None, 0))(WEIGHT, ROWS)
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-6), found, wanted)


@pytest.mark.parametrize("at_once", [1, 3])
def test_gradients_of_what_rows_share_are_summed(at_once):
    found = jax.grad(lambda w: loss(w, lambda f, w: in_turn(f, w, ROWS, at_once)))(WEIGHT)
    wanted = jax.grad(lambda w: loss(w, lambda f, w: jax.vmap(f, (None, 0))(w, ROWS)))(WEIGHT)
    np.testing.assert_allclose(found, wanted, rtol=1e-5)


def test_values_and_gradients_are_those_of_one_device_and_uneven_shares_are_refused():
    environment = os.environ | {"JAX_NUM_CPU_DEVICES": "4", "JAX_PLATFORMS": "cpu"}
    ran = subprocess.run(
        [
            sys.executable,
            "-c",
            ON_DEVICES,
            str(ROOT),
            str(ROOT / "tests" / "network"),
            str(ROOT / "tests" / "support"),
        ],
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert ran.stdout == "held\n", ran.stderr[-2000:]


def test_only_so_many_are_at_work_at_once():
    """On CPUs the compiled program has no array of all rows' inner values."""
    width = 1 << 14
    inner = lambda _, x: jnp.sort(jnp.outer(x, jnp.arange(width, dtype=x.dtype)), axis=-1).sum()  # noqa: E731

    def bytes_of(at_once):
        program = jax.jit(lambda x: in_turn(inner, (), x, at_once)).lower(jnp.ones((16, 4))).compile()
        return program.memory_analysis().temp_size_in_bytes

    if jax.default_backend() == "cpu":
        assert bytes_of(1) * 4 < bytes_of(16)


@pytest.mark.parametrize("count", [0, 1, 4, 5, 8, 11])
def test_blocks_of_rows_give_what_all_rows_give(count):
    """Values, and both gradients: by the rows, and by what the function closes over. The last block is part filled."""
    rows = jax.random.normal(jax.random.key(2), (count, 5))

    def total(over):
        def of(weight, rows):
            return jnp.sum(over(lambda some: jnp.tanh(some @ weight) * some[:, 0], rows) ** 2)

        return jax.value_and_grad(of, (0, 1))(WEIGHT, rows)

    found = total(lambda f, rows: in_blocks(f, rows, 4))
    wanted = total(lambda f, rows: f(rows))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-7), found, wanted)


def test_blocks_of_batches_are_those_of_each():
    rows = jax.random.normal(jax.random.key(3), (3, 10, 5))
    found = jax.vmap(lambda x: in_blocks(lambda some: some @ WEIGHT, x, 4))(rows)
    np.testing.assert_allclose(found, rows @ WEIGHT, rtol=1e-5, atol=1e-6)


def test_no_more_than_a_block_is_computed_at_once():
    """The peak of memory does not grow with the rows."""

    def wide(some):
        return jnp.sin(some[:, :1] * jnp.arange(1.0, 20_001.0)).sum(axis=-1)

    def bytes_of(count):
        program = jax.jit(lambda rows: in_blocks(wide, rows, 4)).lower(jnp.ones((count, 5))).compile()
        return program.memory_analysis().temp_size_in_bytes

    assert bytes_of(400) < 2 * bytes_of(8)
