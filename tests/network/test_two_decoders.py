"""A prior with two decoders says what the one says that fits: with normals known, and with none."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from places import ROOT

from more2_jax.config import load_config
from more2_jax.network.prior import check_shapes, encode_one, init_prior, load_prior, save_prior, sdf_one
from more2_jax.network.two_decoders import knows_normals
from train.run.settings import TrainingRun
from train.run.start import one_decoder, started_warm
from train.tools import join
from train.tools.join import joined


@pytest.fixture(scope="module")
def both():
    """Random weights of a small prior with two decoders, which say different things."""
    model = load_config(ROOT / "configs" / "tiny.yaml", TrainingRun).model
    look_up = {"local_blocks": (1, 3), "local_channels": 4, "bandwidths": (0.1,), "normals": True}
    decoder = dataclasses.replace(model.decoder, narrow_skip=False, **look_up)
    prior = init_prior(dataclasses.replace(model, decoder=decoder, bare_decoder=True), jax.random.key(3))
    moved = jax.tree.map(lambda x: 1.3 * x, prior.params["bare_decoder"])
    return dataclasses.replace(prior, params=prior.params | {"bare_decoder": moved})


@pytest.fixture(scope="module")
def cloud():
    points = np.random.default_rng(4).normal(size=(100, 3))
    unit = points / np.linalg.norm(points, axis=1, keepdims=True)
    return jnp.asarray(unit * [0.5, 0.3, 0.2], jnp.float32), jnp.asarray(unit, jnp.float32)


@pytest.fixture(scope="module")
def embeddings(both, cloud):
    """One cloud with all normals, with some, and with none: codes and anchors are the same."""
    points, unit = cloud
    normals = (unit, jnp.zeros_like(unit).at[:40].set(unit[:40]), jnp.zeros_like(unit))
    encode = jax.jit(encode_one)
    return [encode(both, points, jnp.ones(len(points), bool), n) for n in normals]


distances, side_by_side = jax.jit(sdf_one), jax.jit(jax.vmap(sdf_one, in_axes=(None, 0, None)))


def test_each_object_is_asked_by_the_decoder_that_fits_it(both, embeddings, cloud):
    q = 1.2 * cloud[0][:30]
    seeing, bare = (one_decoder(both, normals) for normals in (True, False))
    assert (seeing.config.decoder.normals, bare.config.decoder.normals) == (True, False)
    for prior in (seeing, bare):
        check_shapes(prior, "one of two")
    for embedding, one, other in zip(embeddings, (seeing, seeing, bare), (bare, bare, seeing), strict=True):
        found = distances(both, embedding, q)
        np.testing.assert_allclose(found, distances(one, embedding, q), atol=2e-6)
        assert np.abs(found - distances(other, embedding, q)).max() > 1e-2


def test_objects_side_by_side_are_asked_by_decoders_of_their_own(both, embeddings, cloud):
    """In float64, as rounding of a random decoder in float32 is as large as what one might get wrong."""
    with jax.enable_x64(True):
        prior, each, q = jax.tree.map(
            lambda x: jnp.asarray(x, jnp.float64) if x.dtype == jnp.float32 else x,
            (both, embeddings, 1.2 * cloud[0][:30]),
        )
        together = side_by_side(prior, jax.tree.map(lambda *x: jnp.stack(x), *each), q)
        for row, embedding in zip(together, each, strict=True):
            np.testing.assert_allclose(row, distances(prior, embedding, q), atol=1e-9)


def test_without_normals_anywhere_none_is_known(both, cloud):
    embedding = jax.jit(encode_one)(both, cloud[0], jnp.ones(100, bool))
    assert not knows_normals(embedding)
    assert not knows_normals(dataclasses.replace(embedding, anchors=()))


def test_two_decoders_are_joined_stored_and_taken_apart_again(both, tmp_path):
    seeing, bare = (one_decoder(both, normals) for normals in (True, False))
    for name, prior in {"seeing": seeing, "bare": bare}.items():
        save_prior(prior, tmp_path / f"{name}.npz")
    join.main(str(tmp_path / "bare.npz"), str(tmp_path / "seeing.npz"), tmp_path / "two.npz")
    again = load_prior(tmp_path / "two.npz")
    assert (again.name, again.config) == ("two", both.config)
    for part, file in (("decoder", "seeing"), ("bare_decoder", "bare")):
        jax.tree.map(
            np.testing.assert_array_equal,
            again.params[part],
            load_prior(tmp_path / f"{file}.npz").params["decoder"],
        )
    for config in (seeing.config, bare.config):  # training goes on from the one that is trained
        assert started_warm(config, str(tmp_path / "two.npz"), "mine").config == config


def test_decoders_of_other_encoders_or_settings_are_not_joined(both):
    seeing, bare = (one_decoder(both, normals) for normals in (True, False))
    other = dataclasses.replace(
        bare, params=bare.params | {"encoder": jax.tree.map(lambda x: x + 1, bare.params["encoder"])}
    )
    with pytest.raises(ValueError, match="other encoders"):
        joined(other, seeing)
    for pair in (
        (bare, bare),
        (seeing, seeing),
        (dataclasses.replace(bare, config=dataclasses.replace(bare.config, inv_gain=7.0)), seeing),
    ):
        with pytest.raises(ValueError, match="other settings"):
            joined(*pair)


def test_draws_are_no_part_of_the_weights_and_those_of_the_seeing_decoder_stay(both):
    seeing, bare = (one_decoder(both, normals) for normals in (True, False))
    seeing = dataclasses.replace(seeing, config=dataclasses.replace(seeing.config, draws=4))
    assert bare.config.draws == 1
    assert joined(bare, seeing).config.draws == 4
