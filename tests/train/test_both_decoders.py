"""Training both decoders together: each learns what it would learn alone, and the encoder from both."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from places import ROOT
from sphere_shards import sphere_shards

from more2_jax.config import load_config
from more2_jax.network.prior import init_prior, save_prior
from train.run.settings import TrainingRun
from train.run.shape_mix import load_mix
from train.run.start import one_decoder, started_warm
from train.run.state import trained
from train.run.validation import validate
from train.shards.losses import total_loss
from train.shards.sampling import sample_batch


@pytest.fixture(scope="module")
def training():
    run = load_config(ROOT / "configs" / "tiny.yaml", TrainingRun)
    return dataclasses.replace(
        run.training, train="decoder", batch=2, queries=16, warmup_steps=0, sign_weight=0.2
    )


@pytest.fixture(scope="module")
def both():
    model = load_config(ROOT / "configs" / "tiny.yaml", TrainingRun).model
    look_up = {"local_blocks": (1, 3), "local_channels": 4, "bandwidths": (0.1,), "normals": True}
    decoder = dataclasses.replace(model.decoder, narrow_skip=False, **look_up)
    return init_prior(dataclasses.replace(model, decoder=decoder, bare_decoder=True), jax.random.key(3))


@pytest.fixture(scope="module")
def shapes(tmp_path_factory):
    return load_mix([sphere_shards(tmp_path_factory.mktemp("shards"))], "train")[0]


@pytest.fixture(scope="module")
def gradients(both, shapes, training):
    """Loss terms, and gradient by all weights: of both decoders together, then of each alone.

    In float64: rounding must not send a unit to the other side of its kink in one of the programs alone.
    """
    draw = jax.jit(sample_batch, static_argnames=("config", "points"))
    sample = draw(jax.random.key(5), shapes, jnp.arange(2), training, points=64)

    @jax.jit
    def gradient(prior, sample):
        def loss(params):
            return total_loss(dataclasses.replace(prior, params=params), sample, training, jax.random.key(1))

        return jax.grad(loss, has_aux=True)(prior.params)

    alone = one_decoder(both, normals=True), one_decoder(both, normals=False)
    with jax.enable_x64(True):
        return [gradient(*jax.tree.map(doubled, (prior, sample))) for prior in (both, *alone)]


def doubled(x):
    return jnp.asarray(x, jnp.float64) if jnp.issubdtype(x.dtype, jnp.floating) else x


@pytest.mark.slow
def test_each_decoder_learns_what_it_would_learn_alone(gradients):
    (found, terms), seeing, bare = gradients
    assert set(terms) == {"sdf", "sign", "bare_sdf", "bare_sign"}
    for name, of, (alone, own) in (("decoder", "", seeing), ("bare_decoder", "bare_", bare)):
        for term in ("sdf", "sign"):
            np.testing.assert_allclose(terms[of + term], own[term], rtol=1e-4)
        agree(found[name], alone["decoder"])


@pytest.mark.slow
def test_the_encoder_learns_from_both(gradients):
    """Its gradient is the sum of those that each decoder alone has for it."""
    both, seeing, bare = (tree["encoder"] for tree, _ in gradients)
    agree(both, jax.tree.map(jnp.add, seeing, bare))
    assert max(np.abs(x).max() for x in jax.tree.leaves(bare)) > 0


def agree(found, expected):
    largest = max(np.abs(x).max() for x in jax.tree.leaves(expected))
    assert largest > 0
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4 * largest)


def test_steps_of_the_decoder_change_both_and_leave_the_encoder(both, training):
    assert set(trained(both.params, training)) == {"decoder", "bare_decoder"}
    assert set(trained(both.params, dataclasses.replace(training, train="all"))) == set(both.params)


def test_both_go_on_from_weights_that_have_both_and_from_no_others(both, tmp_path):
    save_prior(both, tmp_path / "two.npz", half=False)
    begun = started_warm(both.config, str(tmp_path / "two.npz"), "mine")
    assert (begun.name, begun.config) == ("mine", both.config)
    jax.tree.map(np.testing.assert_array_equal, begun.params, both.params)
    save_prior(one_decoder(both, normals=True), tmp_path / "one.npz", half=False)
    with pytest.raises(ValueError, match="its bare_decoder is False; needed True"):
        started_warm(both.config, str(tmp_path / "one.npz"), "mine")


@pytest.mark.slow
def test_validation_scores_both(both, tmp_path, training):
    val = load_mix([sphere_shards(tmp_path)], "train")[0]
    eight = jax.tree.map(lambda x: jnp.concatenate([x] * 8)[:8], val)
    scores = validate(both, eight, training)
    for normals, of in ((True, ""), (False, "bare_")):
        alone = validate(one_decoder(both, normals), eight, training)
        for k in ("sdf_l1", "near_sign"):
            np.testing.assert_allclose(scores[of + k], alone[k], rtol=1e-4)
