"""Scores of the prior: nothing of the true center and size helps where they are debiased."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.prior_scores import elsewhere, field_scores, score_batch, see_twice
from train.shards.signed_distance import BOX

RADIUS = 0.4


@pytest.fixture(scope="module")
def seen():
    """A sphere seen twice, with exact distances."""
    rng = np.random.default_rng(0)
    unit = rng.normal(size=(4, 128, 3))
    unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
    queries = rng.uniform(-BOX, BOX, (40_000, 3))
    sdf = np.concatenate([queries, np.linalg.norm(queries, axis=1, keepdims=True) - RADIUS], axis=1)
    shape = {"views": RADIUS * unit, "normals": unit, "sdf_near": sdf[:500], "sdf_uniform": sdf}
    return see_twice(shape, 2, len(queries), 0.0, np.random.default_rng(1))


def test_debiased_clouds_and_queries_move_together(seen):
    moved = elsewhere(seen, np.random.default_rng(2), debiased=True)
    unit = moved["unit"]
    assert abs(np.log(unit)) > 0.1  # or little is shown
    shift = moved["clouds"][0, 0] / unit - seen["clouds"][0, 0]
    assert np.abs(shift).max() > 0.5
    np.testing.assert_allclose(moved["clouds"] / unit - shift, seen["clouds"], atol=1e-9)
    for name in ("near", "uniform"):
        np.testing.assert_allclose(moved[name][:, :3] / unit - shift, seen[name][:, :3], atol=1e-9)
        np.testing.assert_array_equal(moved[name][:, 3], seen[name][:, 3])
    outside = (moved["beyond"] / unit - shift) @ seen["rotation"][0]
    reach = np.abs(outside).max(axis=1)
    assert len(outside) == len(seen["uniform"]) and reach.min() >= BOX - 1e-9 and reach.max() > 1.9 * BOX


@pytest.mark.slow
def test_scores_are_the_same_in_another_unit_and_place(seen, tiny_prior):
    """In float64, where nothing but rounding is left. The random field is far too large or small: its size counts."""
    few = dict(seen) | {name: seen[name][:300] for name in ("near", "uniform")}
    with jax.enable_x64(True):
        prior = dataclasses.replace(
            tiny_prior, params=jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), tiny_prior.params)
        )
        found = []
        for debiased in (False, True):
            one = elsewhere(few, np.random.default_rng(3), debiased)
            batch = {k: jnp.asarray(v, jnp.float64)[None] for k, v in one.items() if k != "rotation"}
            found.append(jax.device_get(score_batch(prior, batch))[1])
    plain, debiased = found
    for name in ("near_sign", "iou", "near_error", "true_error"):
        np.testing.assert_allclose(debiased[name], plain[name], rtol=1e-9)
    assert np.isnan(plain["wide_iou"]) and np.isfinite(debiased["wide_iou"])
    assert debiased["true_error"] != debiased["near_error"]


@pytest.mark.parametrize("radius", [0.3, 0.8])
def test_overlap_and_errors_of_a_sphere_of_another_size(seen, radius):
    """In the wide box overlap is the ratio of volumes; in the usual one a sphere that sticks out is cut off."""
    moved = elsewhere(seen, np.random.default_rng(4), debiased=True)
    unit = float(moved["unit"])
    center = moved["near"][0, :3] - unit * seen["near"][0, :3]
    sphere = lambda q: (jnp.linalg.norm(q - center, axis=1) / unit - radius) / 2  # noqa: E731
    scores = field_scores(
        sphere, jnp.asarray(2.0 * unit), moved
    )  # F_s twice too large: distances in it are half
    true = min(radius / RADIUS, RADIUS / radius) ** 3
    assert float(scores["wide_iou"]) == pytest.approx(true, rel=0.04)
    if radius > BOX:
        assert float(scores["iou"]) > 1.2 * true
    assert float(scores["true_error"]) == pytest.approx(abs(radius - RADIUS), rel=1e-4)
    assert float(scores["near_error"]) != pytest.approx(abs(radius - RADIUS), rel=0.1)
