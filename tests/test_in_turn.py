"""Rows in turn give what rows at once give: values, gradients, and shared over devices."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from more2_jax.in_turn import in_turn

ROWS = {"a": jax.random.normal(jax.random.key(0), (12, 5)), "b": jnp.arange(12.0)}


def one(row):
    return {"sum": jnp.sin(row["a"]).sum() * row["b"], "row": row["a"] + row["b"]}


@pytest.mark.parametrize(("at_once", "devices"), [(1, 1), (4, 1), (5, 1), (50, 1), (2, 3), (1, 12)])
def test_the_same_as_all_at_once(at_once, devices):
    found, wanted = in_turn(one, ROWS, at_once, devices), jax.vmap(one)(ROWS)
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-6), found, wanted)


@pytest.mark.parametrize(("at_once", "devices"), [(1, 1), (3, 2)])
def test_gradients_of_what_rows_share_are_summed(at_once, devices):
    def loss(weight, over):
        return (over(lambda row: jnp.tanh(row["a"] @ weight) + row["b"]) ** 2).sum()

    weight = jax.random.normal(jax.random.key(1), (5,))
    found = jax.grad(lambda w: loss(w, lambda f: in_turn(f, ROWS, at_once, devices)))(weight)
    wanted = jax.grad(lambda w: loss(w, lambda f: jax.vmap(f)(ROWS)))(weight)
    np.testing.assert_allclose(found, wanted, rtol=1e-5)


def test_only_so_many_are_at_work_at_once():
    """On CPUs the compiled program has no array of all rows' inner values."""
    width = 1 << 14
    inner = lambda x: jnp.sort(jnp.outer(x, jnp.arange(width, dtype=x.dtype)), axis=-1).sum()  # noqa: E731

    def bytes_of(at_once):
        program = jax.jit(lambda x: in_turn(inner, x, at_once)).lower(jnp.ones((16, 4))).compile()
        return program.memory_analysis().temp_size_in_bytes

    if jax.default_backend() == "cpu":
        assert bytes_of(1) * 4 < bytes_of(16)


def test_rows_that_devices_cannot_share_are_an_error():
    with pytest.raises(TypeError, match="reshape"):
        in_turn(one, ROWS, 1, devices=5)
