"""Rounding changes what it says it does, by as much as half a step of bfloat16, and nothing afterwards."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval import bfloat16
from eval.bfloat16 import angles, answered, cosine, field_rows, gradient_of, rounded
from eval.prior_scores import see_twice


@pytest.fixture(scope="module")
def batch():
    """Two spheres seen twice."""
    rng = np.random.default_rng(0)
    unit = rng.normal(size=(4, 128, 3))
    unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
    queries = rng.uniform(-0.6, 0.6, (800, 3))
    sdf = np.concatenate([queries, np.linalg.norm(queries, axis=1, keepdims=True) - 0.4], axis=1)
    shape = {"views": 0.4 * unit, "normals": unit, "sdf_near": sdf[:400], "sdf_uniform": sdf}
    seen = [see_twice(shape, 2, 800, 0.0, np.random.default_rng(k)) for k in range(2)]
    return seen, {k: np.stack([s[k] for s in seen]) for k in seen[0]}


@pytest.fixture(scope="module")
def exact(tiny_prior, batch):
    with rounded(""):
        return answered(tiny_prior, batch[1]), gradient_of(tiny_prior, batch[1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("parts", "turns_stay", "least"),
    [
        ("d", True, 0.9),
        pytest.param(
            "e", False, 0.3, marks=pytest.mark.slow
        ),  # all programs of a process are compiled anew each time
        pytest.param("de", False, 0.3, marks=pytest.mark.slow),
    ],
)
def test_each_part_is_rounded_and_little_changes(tiny_prior, batch, exact, parts, turns_stay, least):
    with rounded(parts):
        answers, gradient = answered(tiny_prior, batch[1]), gradient_of(tiny_prior, batch[1])
    turned = np.abs(answers["turn"] - exact[0]["turn"]).max()
    assert (turned < 1e-5) == turns_stay  # codes are the encoder's alone
    change = np.abs(answers["distance"] - exact[0]["distance"]).max() / np.abs(exact[0]["distance"]).max()
    assert 1e-6 < change < 0.1
    # Codes of a sphere from random weights point wherever rounding has them point.
    assert least < cosine(gradient, exact[1]) < 1


@pytest.mark.slow
def test_nothing_is_rounded_afterwards(tiny_prior, batch, exact):
    again = answered(tiny_prior, batch[1])
    for name, value in exact[0].items():
        np.testing.assert_array_equal(again[name], value)


@pytest.mark.slow
def test_figures_of_what_is_not_rounded_say_that_nothing_changed(batch, exact):
    rows = {r.name: r for r in field_rows("float32", [exact[0]], [exact[0]], batch[0], [1, 1])}
    assert rows["change of distances"].value == 0
    assert rows["change of slopes"].value == 0
    assert rows["error of distances"].better == "lower"
    assert rows["overlap"].better == "higher"
    assert rows["overlap"].count == 2


def test_angles_are_exact_for_small_ones():
    a = np.array([[1.0, 0.0, 0.0]] * 3)
    b = np.array([[1.0, 1e-9, 0.0], [0.0, 2.0, 0.0], [-3.0, 0.0, 0.0]])
    np.testing.assert_allclose(angles(a, b), [np.rad2deg(1e-9), 90.0, 180.0], rtol=1e-6)


def test_products_are_of_rounded_factors_added_in_float32():
    one = jnp.full((1, 300), 1 + 2.0**-9, jnp.float32)  # half of bfloat16's step above 1: rounds to 1
    assert bfloat16.product(one, jnp.ones((300, 1)), False)[0, 0] == 300  # bfloat16 has no 301, but 300
    odd = bfloat16.product(jnp.ones((1, 301)), jnp.ones((301, 1)), False)
    assert odd.dtype == jnp.float32
    assert odd[0, 0] == 301


def test_compiled_programs_are_forgotten_on_the_way_in_and_out(monkeypatch):
    cleared = []
    monkeypatch.setattr(jax, "clear_caches", lambda: cleared.append(1))
    with rounded("d"):
        assert len(cleared) == 1
    assert len(cleared) == 2
