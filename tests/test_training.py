"""Losses by definition; a training run that is stopped and resumed is the run that was not stopped."""

from __future__ import annotations

import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from places import ROOT

from more2_jax.config import TrainingRun, load_config, to_yaml
from more2_jax.data.sampling import sample_batch
from more2_jax.data.shards import load_shapes
from more2_jax.losses import contrast_loss, sdf_loss, sign_loss, total_loss, turn_loss, up_loss
from more2_jax.prior import load_prior
from train.prior import main


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    """Spheres of several sizes, in the layout of training shards."""
    folder, rng = tmp_path_factory.mktemp("shards"), np.random.default_rng(0)
    radius = rng.uniform(0.2, 0.45, 40)
    unit = rng.normal(size=(40, 4, 64, 3))
    unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
    queries = rng.uniform(-0.55, 0.55, (40, 200, 3))
    distance = np.linalg.norm(queries, axis=-1) - radius[:, None]
    sdf = np.concatenate([queries, distance[..., None]], axis=-1).astype(np.float16)
    arrays = {"views": unit * radius[:, None, None, None], "sdf_uniform": sdf, "sdf_near": sdf}
    shard = folder / "shard_000"
    shard.mkdir()
    for name, array in arrays.items():
        np.save(shard / f"{name}.npy", array.astype(np.float16))
    meta = [{"name": f"sphere_{k}", "split": "val" if k % 5 == 0 else "train"} for k in range(40)]
    (shard / "meta.json").write_text(json.dumps(meta))
    return folder


@pytest.fixture(scope="module")
def run():
    return load_config(ROOT / "configs" / "tiny.yaml", TrainingRun)


def test_sdf_loss_weighs_near_surface_errors_fully_and_others_by_half():
    truth = jnp.array([0.05, -0.05, 0.3, -0.3])
    loss = sdf_loss(truth + 0.1, truth, near_surface=0.1)
    np.testing.assert_allclose(loss, 0.1 * (1 + 1 + 0.5 + 0.5) / 4, rtol=1e-6)
    assert sdf_loss(truth, truth, 0.1) == 0


def test_contrast_loss_is_least_when_partners_agree():
    codes = jax.random.normal(jax.random.key(0), (6, 16))
    right = contrast_loss(codes, codes, 0.07)
    assert right < 0.01 < contrast_loss(codes, codes[::-1], 0.07)
    # All codes alike tell nothing apart: the loss is that of guessing.
    alike = jnp.ones((6, 16))
    np.testing.assert_allclose(contrast_loss(alike, alike, 0.07), np.log(6), rtol=1e-5)


def test_turn_loss_is_zero_for_equal_vectors_and_two_for_orthogonal_ones():
    first = jnp.zeros((1, 3, 4)).at[0, 0, 0].set(1.0)
    second = jnp.zeros((1, 3, 4)).at[0, 1, 0].set(1.0)
    assert turn_loss(jnp.stack([first, first], axis=1)) == 0
    np.testing.assert_allclose(turn_loss(jnp.stack([first, second], axis=1)), 2.0)


def test_sign_loss_is_that_of_a_coin_at_zero_and_none_when_sure():
    truth = jnp.array([0.2, -0.2])
    np.testing.assert_allclose(sign_loss(jnp.zeros(2), truth, 0.01), np.log(2), rtol=1e-6)
    assert sign_loss(truth, truth, 0.01) < 1e-6
    np.testing.assert_allclose(sign_loss(-truth, truth, 0.01), 20.0, rtol=1e-4)


def test_up_loss_is_zero_where_the_first_third_points_up_and_one_where_it_says_nothing():
    up = jnp.zeros((1, 2, 3, 6)).at[..., 2, :2].set(6**-0.5)
    np.testing.assert_allclose(up_loss(up), 0.0, atol=1e-12)
    np.testing.assert_allclose(up_loss(-up), 4.0, rtol=1e-6)
    np.testing.assert_allclose(up_loss(jnp.zeros((1, 2, 3, 6))), 1.0)


def test_gradients_of_the_training_loss_are_finite(shards, run, tiny_prior):
    sample = sample_batch(jax.random.key(0), load_shapes(shards, "train"), jnp.arange(4), run.training, 64)

    def loss(params):
        prior = dataclasses.replace(tiny_prior, params=params)
        return total_loss(prior, sample, run.training, jax.random.key(1))[0]

    gradient = jax.jit(jax.grad(loss))(tiny_prior.params)
    assert all(bool(jnp.isfinite(g).all()) for g in jax.tree.leaves(gradient))
    assert any(float(jnp.abs(g).max()) > 0 for g in jax.tree.leaves(gradient))


@pytest.mark.slow
def test_a_resumed_run_equals_one_that_was_not_stopped(shards, run, tmp_path):
    long = tmp_path / "long.yaml"
    training = dataclasses.replace(run.training, steps=8, validate_every=4)
    long.write_text(to_yaml(dataclasses.replace(run, training=training)))
    main(long, (shards,), tmp_path / "whole", name="sphere")
    # Stopped at its first checkpoint, as a killed run would leave it: the second is taken away.
    main(long, (shards,), tmp_path / "parts", name="sphere")
    shutil.rmtree(tmp_path / "parts" / "checkpoints" / "8")
    main(long, (shards,), tmp_path / "parts", name="sphere")
    whole, parts = (load_prior(tmp_path / k / "weights.npz") for k in ("whole", "parts"))
    for a, b in zip(jax.tree.leaves(whole.params), jax.tree.leaves(parts.params), strict=True):
        np.testing.assert_array_equal(a, b)
    lines = [json.loads(line) for line in (tmp_path / "whole" / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [4, 8]
    assert all(np.isfinite(v) for line in lines for v in line["val"].values())


def test_a_run_without_shards_says_so(run, tmp_path):
    config = tmp_path / "c.yaml"
    config.write_text(to_yaml(run))
    with pytest.raises(ValueError, match="no shards"):
        main(config, (tmp_path,), tmp_path / "out")
