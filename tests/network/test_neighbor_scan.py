"""Sums and maps over neighbors: the same numbers and gradients as with all edges written out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from more2_jax.network.neighbor_scan import over_neighbors


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def edge(neighbor: dict, own: jax.Array, shared: jax.Array, each: jax.Array):
    product = jnp.sin(neighbor["a"] + own) * (neighbor["b"] @ shared) * each[:, None]
    return product, (product**2).sum(axis=-1)


def written_out(source: dict, own: jax.Array, shared: jax.Array, each: jax.Array, index: jax.Array):
    rows = [
        edge(jax.tree.map(lambda x, j=j: x[index[:, j]], source), own, shared, each[j])
        for j in range(index.shape[1])
    ]
    return sum(a for a, _ in rows), jnp.stack([b for _, b in rows])


def example(seed: int, repeated: bool):
    keys = jax.random.split(jax.random.key(seed), 6)
    source = {"a": jax.random.normal(keys[0], (7, 4)), "b": jax.random.normal(keys[1], (7, 3))}
    index = jnp.zeros((5, 3), int) if repeated else jax.random.randint(keys[2], (5, 3), 0, 7)
    own, shared = jax.random.normal(keys[3], (5, 4)), jax.random.normal(keys[4], (3, 4))
    return source, own, shared, jax.random.normal(keys[5], (3, 5)), index


@pytest.mark.parametrize("repeated", [False, True])
@pytest.mark.parametrize("jit", [False, True])
def test_values_and_gradients(repeated: bool, jit: bool, x64: None):
    *arguments, index = example(0, repeated)

    def loss(function, *given):
        total, kept = function(*given, index)
        return jnp.sum(total * jnp.arange(4.0)) + jnp.sum(jnp.cos(kept))

    def by_scan(*given):
        return over_neighbors(edge, *given)

    def both(function):
        run = jax.value_and_grad(lambda *given: loss(function, *given), argnums=(0, 1, 2, 3))
        return (jax.jit(run) if jit else run)(*arguments)

    ours, plain = both(by_scan), both(written_out)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-12), ours, plain)


def test_under_vmap_and_with_an_empty_half(x64: None):
    examples = [example(seed, False) for seed in range(3)]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *examples)

    def total_only(source, own, shared, each, index):
        return over_neighbors(lambda *given: (edge(*given)[0], ()), source, own, shared, each, index)

    total, kept = jax.vmap(total_only)(*batch)
    assert kept == ()
    for k, one in enumerate(examples):
        np.testing.assert_allclose(total[k], written_out(*one)[0], rtol=1e-12, atol=1e-12)


def test_second_derivatives_exist(x64: None):
    *arguments, index = example(1, False)

    def slope(own):
        return jax.grad(lambda o: over_neighbors(edge, arguments[0], o, *arguments[2:], index)[0].sum())(own)

    numeric = (slope(arguments[1] + 1e-4) - slope(arguments[1] - 1e-4)) / 2e-4
    exact = jax.grad(lambda o: slope(o).sum())(arguments[1])
    np.testing.assert_allclose(exact, numeric, rtol=1e-5, atol=1e-6)
