"""Training the decoder alone: codes stay to the bit, and a decoder that begins to see normals says what it said."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from places import ROOT
from sphere_shards import sphere_shards

from more2_jax.config import load_config
from more2_jax.network.prior import check_shapes, encode_ordered, init_prior, load_prior, save_prior, sdf_one
from train.run.devices import device_mesh
from train.run.settings import TrainingRun
from train.run.shape_mix import load_mix
from train.run.start import looking_up_more, started_warm
from train.run.state import initial_state, training_step
from train.shards.sampling import sample_batch


@pytest.fixture(scope="module")
def training():
    run = load_config(ROOT / "configs" / "tiny.yaml", TrainingRun)
    return dataclasses.replace(
        run.training, train="decoder", batch=2, queries=16, warmup_steps=0, sign_weight=0.2
    )


@pytest.fixture(scope="module")
def prior():
    """Random weights of `tiny` with a look-up at two levels, as they come from a file."""
    model = load_config(ROOT / "configs" / "tiny.yaml", TrainingRun).model
    decoder = dataclasses.replace(
        model.decoder, narrow_skip=False, local_blocks=(1, 3), local_channels=4, bandwidths=(0.1,)
    )
    return init_prior(dataclasses.replace(model, decoder=decoder), jax.random.key(0))


@pytest.fixture(scope="module")
def seeing(prior):
    return looking_up_more(
        prior,
        dataclasses.replace(prior.config, decoder=dataclasses.replace(prior.config.decoder, normals=True)),
    )


@pytest.fixture(scope="module")
def sample(tmp_path_factory, training):
    shapes = load_mix([sphere_shards(tmp_path_factory.mktemp("shards"))], "train")[0]
    draw = jax.jit(sample_batch, static_argnames=("config", "points"))
    known = dataclasses.replace(training, normals_unknown_probability=0.0)
    return shapes, draw(jax.random.key(0), shapes, jnp.arange(2), known, points=64)


@pytest.mark.slow
def test_a_decoder_that_begins_to_see_normals_says_what_it_said(prior, seeing, sample):
    check_shapes(seeing, "widened")
    one = jax.tree.map(lambda x: x[0, 0], sample[1])
    normals = jnp.where(one.mask[:, None], one.points, 0.0) / 0.45
    embedding = jax.jit(encode_ordered)(prior, one.points, one.mask, normals)
    before, after = (jax.jit(sdf_one)(p, embedding, one.queries) for p in (prior, seeing))
    assert np.ptp(before) > 1e-3
    np.testing.assert_allclose(after, before, atol=1e-6)


def test_warm_start_takes_weights_of_a_decoder_without_normals(prior, tmp_path):
    save_prior(prior, tmp_path / "plain.npz", half=False)
    decoder = dataclasses.replace(prior.config.decoder, normals=True)
    model = dataclasses.replace(prior.config, decoder=decoder)
    started = started_warm(model, str(tmp_path / "plain.npz"), "mine")
    assert started.config == model
    save_prior(started, tmp_path / "seeing.npz", half=False)
    assert load_prior(tmp_path / "seeing.npz").config.decoder.normals
    with pytest.raises(ValueError, match="its decoder is"):  # but not the other way
        started_warm(prior.config, str(tmp_path / "seeing.npz"), "mine")


@pytest.mark.slow
def test_a_step_of_the_decoder_leaves_the_encoder_to_the_bit(seeing, sample, training):
    mesh, state = device_mesh(1), initial_state(seeing, training)
    before = jax.device_get(state.params)
    step = jax.jit(training_step.__wrapped__, static_argnames=("model", "config", "mesh"))
    for _ in range(2):
        state, terms = step(state, sample[0], jnp.arange(2), model=seeing.config, config=training, mesh=mesh)
    assert set(terms) == {"sdf", "sign", "gradient"}
    for weights in (state.params, state.average):
        jax.tree.map(np.testing.assert_array_equal, before["encoder"], jax.device_get(weights["encoder"]))
    rows = len(before["decoder"]["layer_0"]["direction"]) - 2 * 11
    changed = np.abs(
        np.asarray(state.params["decoder"]["layer_0"]["direction"])
        - before["decoder"]["layer_0"]["direction"]
    )
    assert (changed.max(axis=1) > 0)[rows:].mean() > 0.5  # rows of zeros learn
