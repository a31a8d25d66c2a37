"""Ψ: the folded affine form is the plain one, smooth enough to descend, random only while training."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from places import ROOT

from more2_jax.config import DecoderConfig, EncoderConfig, PriorConfig, load_config
from more2_jax.network.decoder import Decoder, bfloat16_product
from more2_jax.network.prior import field_sdf, init_prior, object_field, sdf, sdf_one
from more2_jax.network.published_weights import prior_from_published
from more2_jax.types import Embedding
from train.run.settings import TrainingRun

CONFIGS = ROOT / "configs"
# Compiled: one by one, their operations would take longer.
distance, field_of, distance_in = jax.jit(sdf_one), jax.jit(object_field), jax.jit(field_sdf)
slopes_of = jax.jit(jax.grad(lambda prior, code, points: sdf_one(prior, code, points).sum(), argnums=(2, 1)))
rounded_product = jax.jit(bfloat16_product)


@partial(jax.jit, static_argnames=("channels", "seed"))
def random_code(channels: int, seed: int = 0) -> Embedding:
    k_inv, k_eqv = jax.random.split(jax.random.key(seed))
    eqv = jax.random.normal(k_eqv, (3, channels))
    return Embedding(
        inv=0.1 * jax.random.normal(k_inv, (channels,)),
        eqv=eqv / jnp.linalg.norm(eqv),
        scale=jnp.float32(1.7),
        center=jnp.array([0.3, -0.2, 0.1]),
        origin=jnp.zeros(3),
    )


def plain(prior, e: Embedding, points: np.ndarray) -> np.ndarray:
    """Every layer on [g·F_inv, g'·⟨F_eqv, q⟩, |q|], float64, nothing folded; our weights' layout."""
    params = jax.tree.map(lambda x: np.asarray(x, np.float64), prior.params["decoder"])
    c = prior.config
    q = (points - np.asarray(e.center)) / float(e.scale)
    inv = np.broadcast_to(c.inv_gain * np.asarray(e.inv), (len(q), len(e.inv)))
    length = np.linalg.norm(q, axis=1, keepdims=True)
    inputs = np.concatenate([inv, c.eqv_gain * q @ np.asarray(e.eqv), length], axis=1)
    h = inputs
    for i in range(c.decoder.layers):
        layer = params[f"layer_{i}"]
        h = np.concatenate([h, inputs], axis=1) if i == c.decoder.skip_layer else h
        kernel = layer["direction"] / np.linalg.norm(layer["direction"], axis=0) * layer["gain"]
        h = np.maximum(h @ kernel + layer["bias"], 0)
    last = params[f"layer_{c.decoder.layers}"]
    return np.tanh(h @ last["kernel"] + last["bias"])[:, 0]


@pytest.fixture(scope="module", params=["tiny", "wide"])
def prior(request):
    model = load_config(CONFIGS / "tiny.yaml", TrainingRun).model
    if request.param == "wide":
        model = dataclasses.replace(model, decoder=dataclasses.replace(model.decoder, narrow_skip=False))
    return init_prior(model, jax.random.key(2))


def test_folded_form_equals_the_plain_form(prior):
    code = random_code(prior.config.encoder.code)
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    expected = plain(prior, code, points)
    assert np.ptp(expected) > 0.01
    np.testing.assert_allclose(distance(prior, code, points), expected, atol=1e-5)
    field = field_of(prior, code)  # built once, asked in parts
    parts = [distance_in(prior, field, p) for p in np.split(points, 5)]
    np.testing.assert_allclose(np.concatenate(parts), expected, atol=1e-5)


def test_folded_form_equals_the_oracle_in_published_layout():
    weights = oracles.random_weights((16,) * 7, 16, 64, seed=0)
    code = random_code(16)
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    published = {"F_inv": code.inv, "F_eqv": code.eqv.T, "F_s": code.scale, "F_c": code.center}
    expected = oracles.decode(weights, {k: np.asarray(v, np.float64) for k, v in published.items()}, points)
    ours = distance(prior_from_published(weights, "test"), code, points)
    np.testing.assert_allclose(ours, expected, atol=1e-5)


def test_distance_turns_scales_and_shifts_with_the_code(prior):
    """SDF(sRp + t; Φ(sRX + t)) = SDF(p; Φ(X)), canonical units."""
    code = random_code(prior.config.encoder.code)
    points = np.random.default_rng(1).normal(size=(30, 3)).astype(np.float32)
    rotation, scale, shift = (
        np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0],
        3.0,
        np.array([5, 6, 7]),
    )
    moved = Embedding(
        inv=code.inv,
        eqv=jnp.asarray(rotation @ np.asarray(code.eqv), jnp.float32),
        scale=jnp.float32(scale * float(code.scale)),
        center=jnp.asarray(scale * rotation @ np.asarray(code.center) + shift, jnp.float32),
        origin=code.origin,
    )
    ours = distance(prior, moved, (scale * points @ rotation.T + shift).astype(np.float32))
    np.testing.assert_allclose(ours, distance(prior, code, points), atol=2e-5)


def test_gradient_is_finite_at_the_center(prior):
    code = random_code(prior.config.encoder.code)
    by_point, by_code = slopes_of(prior, code, np.asarray(code.center)[None])
    assert np.isfinite(by_point).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(by_code))


def test_distance_is_finite_far_away(prior):
    code = random_code(prior.config.encoder.code)
    far = np.asarray(distance(prior, code, np.float32([[1e6, 0, 0], [0, -1e6, 1e6]])))
    assert np.isfinite(far).all() and (np.abs(far) <= 1).all()


@pytest.mark.slow
def test_dropout_only_while_training():
    config = PriorConfig(
        encoder=EncoderConfig(
            widths=(16,) * 7, code=16, neighbors=4, downsample_factors=(2, 2, 2), points=64
        ),
        decoder=DecoderConfig(hidden=64, layers=4, skip_layer=2, dropout=0.5),
    )
    prior, code = init_prior(config, jax.random.key(0)), random_code(16)
    points = jax.random.normal(jax.random.key(1), (20, 3))

    def distance(train: bool, seed: int) -> np.ndarray:
        rngs = {"dropout": jax.random.key(seed)}
        return np.asarray(
            Decoder(config).apply({"params": prior.params["decoder"]}, code, points, train=train, rngs=rngs)
        )

    np.testing.assert_array_equal(distance(False, 0), distance(False, 1))
    np.testing.assert_array_equal(distance(False, 0), np.asarray(sdf_one(prior, code, points)))
    assert np.abs(distance(True, 0) - distance(True, 1)).max() > 1e-4
    np.testing.assert_array_equal(distance(True, 0), distance(True, 0))


def test_sdf_takes_points_of_the_scan_far_from_zero(tiny_prior):
    """Batched, with float64 origins: a kilometer away gives the same distances."""
    code = random_code(16)
    origin = np.array([[1000.0, -2000.0, 30.0]])
    batch = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[None]), code)
    points = np.random.default_rng(0).normal(size=(1, 20, 3))
    far = Embedding(inv=batch.inv, eqv=batch.eqv, scale=batch.scale, center=batch.center, origin=origin)
    near = distance(tiny_prior, code, points[0].astype(np.float32))
    np.testing.assert_allclose(np.asarray(sdf(tiny_prior, far, points + origin[:, None]))[0], near, atol=1e-6)
    with pytest.raises(ValueError, match=r"needed \(objects, n, 3\)"):
        sdf(tiny_prior, far, np.repeat(points, 2, axis=0))


@pytest.mark.parametrize("platform", ["cpu", "cuda", "tpu"])
@pytest.mark.parametrize("train", [True, False])
def test_products_are_rounded_on_accelerators_while_training_only(prior, platform, train):
    decoder, code = Decoder(prior.config), random_code(prior.config.encoder.code)
    points = jnp.zeros((20, 3))

    def decode(params):
        keys = {"dropout": jax.random.key(0)}
        return decoder.apply({"params": params}, code, points, train, rngs=keys)

    program = jax.jit(decode).trace(prior.params["decoder"]).lower(lowering_platforms=(platform,)).as_text()
    assert ("bf16" in program) == (train and platform != "cpu")


def test_rounded_products_have_three_digits():
    h, kernel = (
        jax.random.normal(jax.random.key(0), (50, 256)),
        jax.random.normal(jax.random.key(1), (256, 64)),
    )
    exact = np.asarray(h, np.float64) @ np.asarray(kernel, np.float64)
    error = np.abs(np.asarray(rounded_product(h, kernel)) - exact) / np.sqrt(256)
    assert 1e-5 < error.max() < 0.02 and error.mean() < 0.003
