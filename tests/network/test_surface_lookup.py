"""The look-up of the observed surface: plane distances it can be checked by, laws of the field, codes left alone."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from places import ROOT

from more2_jax.config import load_config
from more2_jax.geometry.transform import rescale, transform
from more2_jax.network.prior import (
    check_embedding,
    encode_one,
    init_prior,
    load_prior,
    points_read,
    save_prior,
    sdf_one,
)
from more2_jax.network.surface_lookup import POSITIONAL, SurfaceLookup, bounded, surface_width
from more2_jax.network.two_decoders import without_normals
from more2_jax.types import Anchors
from train.run.settings import TrainingRun
from train.run.start import started_warm

BANDWIDTHS = (0.05, 0.2)
placed, field = jax.jit(encode_one), jax.jit(sdf_one)
CODES = ("inv", "eqv", "scale", "center")


def model(**decoder):
    """Settings of a small prior with both look-ups; the encoder reads 64 points, the surface's is of 150."""
    tiny = load_config(ROOT / "configs" / "tiny.yaml", TrainingRun).model
    look_up = {"local_blocks": (1, 3), "local_channels": 4, "bandwidths": (0.1,), "normals": True}
    seen = {"surface_points": 150, "surface_bandwidths": BANDWIDTHS}
    return dataclasses.replace(
        tiny,
        decoder=dataclasses.replace(tiny.decoder, narrow_skip=False, **look_up | seen | decoder),
    )


def random_prior(config, seed=3):
    """Random weights whose center is within the object, as trained ones say: far from it float32 loses moments."""
    prior = init_prior(config, jax.random.key(seed))
    center = jax.tree.map(lambda x: 0.01 * x, prior.params["encoder"]["center"])
    encoder = prior.params["encoder"] | {"center": center}
    return dataclasses.replace(prior, params=prior.params | {"encoder": encoder})


@pytest.fixture(scope="module")
def prior():
    return random_prior(model())


@pytest.fixture(scope="module")
def cloud():
    """Points on an ellipsoid, and their outward normals, of which a third is not known."""
    unit = np.random.default_rng(4).normal(size=(220, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    outward = unit / [0.5, 0.3, 0.2]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    outward[::3] = 0.0
    return jnp.asarray(unit * [0.5, 0.3, 0.2], jnp.float32), jnp.asarray(outward, jnp.float32)


def surface(position, normal, mask=None):
    count = len(position)
    return Anchors(
        offset=jnp.asarray(position, jnp.float32),
        features=None,
        mask=jnp.ones(count, bool) if mask is None else jnp.asarray(mask),
        normal=jnp.asarray(normal, jnp.float32),
    )


@pytest.fixture(scope="module")
def ask():
    module = SurfaceLookup(BANDWIDTHS)
    params = module.init(
        jax.random.key(0), surface(np.zeros((1, 3)), np.zeros((1, 3))), jnp.float32(1.0), method="tabulate"
    )

    @jax.jit
    def asked(anchors: Anchors, scale: jax.Array, q: jax.Array) -> jax.Array:
        bound = module.bind(params)
        return bound.query(bound.tabulate(anchors, scale), q)

    return lambda anchors, scale, q: np.asarray(
        asked(anchors, jnp.float32(scale), jnp.asarray(q, jnp.float32))
    )


def test_over_a_plane_every_width_says_how_high_the_query_stands(ask):
    """Of a dense plane z = 0 facing up: the plane's distance is |z|, the height by normals z."""
    side = np.linspace(-1, 1, 61)
    x, y = (c.ravel() for c in np.meshgrid(side, side))
    plane = surface(np.c_[x, y, 0 * x], np.tile([0.0, 0.0, 1.0], (len(x), 1)))
    z = np.array([-0.04, -0.01, 0.01, 0.03])
    found = ask(plane, 1.0, np.c_[0 * z + 0.01, 0 * z + 0.02, z]).reshape(len(z), len(BANDWIDTHS), -1)
    assert found.shape[1:] == (2, surface_width(1)) and surface_width(2) == 2 * surface_width(1)
    for of_width in np.moveaxis(found, 1, 0):
        np.testing.assert_allclose(of_width[:, 2], bounded(jnp.abs(z)), atol=0.04)
        known = of_width[:, POSITIONAL:]
        # All weight is on known normals; a share of it in place of 1 takes as much off the height.
        np.testing.assert_allclose(known[:, 0], 1.0, atol=1e-5)
        np.testing.assert_allclose(known[:, 1], bounded(jnp.asarray(z)), atol=0.04)


def test_units_order_and_padding_change_nothing(ask, cloud):
    points, normals = (np.asarray(c) for c in cloud)
    q = 1.1 * points[:40]
    expected = ask(surface(points, normals), 1.0, q)
    assert np.ptp(expected, axis=0).min() > 1e-3
    np.testing.assert_allclose(ask(surface(3 * points, normals), 3.0, q), expected, atol=2e-3)
    order = np.random.default_rng(0).permutation(len(points))
    np.testing.assert_allclose(ask(surface(points[order], normals[order]), 1.0, q), expected, atol=2e-3)
    more = np.concatenate([points, np.full((30, 3), 0.1)]), np.concatenate([normals, np.ones((30, 3))])
    real = np.arange(len(points) + 30) < len(points)
    np.testing.assert_allclose(ask(surface(*more, real), 1.0, q), expected, atol=2e-3)


def test_the_field_moves_and_grows_with_the_object(prior, cloud):
    points, normals = cloud
    T = jaxlie.SE3.from_rotation_and_translation(
        jaxlie.SO3.sample_uniform(jax.random.key(0)), jnp.array([3.0, -2.0, 1.0])
    )
    mask, queries = jnp.ones(len(points), bool), 1.2 * points[:40]
    embedding = placed(prior, points, mask, normals)
    check_embedding(prior, jax.tree.map(lambda x: x[None], embedding), "test")
    expected = field(prior, embedding, queries)
    assert np.ptp(expected) > 1e-2
    moved, turned = jax.vmap(lambda p: T @ (2.5 * p)), jax.vmap(lambda n: T.rotation() @ n)
    again = placed(prior, moved(points), mask, turned(normals))
    np.testing.assert_allclose(field(prior, again, moved(queries)), expected, atol=1e-3)
    carried = transform(rescale(embedding, 2.5), T)
    np.testing.assert_allclose(field(prior, carried, moved(queries)), expected, atol=1e-3)


def test_the_encoder_and_its_codes_know_nothing_of_the_points_beside(prior, cloud):
    points, normals = cloud
    assert points_read(prior.config) == 150 > prior.config.encoder.points
    config = dataclasses.replace(prior.config, decoder=model(surface_points=0).decoder)
    fewer = dataclasses.replace(prior, config=config)
    seen, without = (placed(p, points, jnp.ones(len(points), bool), normals) for p in (prior, fewer))
    # To rounding: two programs may add up in another order, by how many threads they have.
    for name in CODES:
        np.testing.assert_allclose(getattr(seen, name), getattr(without, name), rtol=1e-6, atol=1e-6)
    same = partial(np.testing.assert_allclose, rtol=1e-6, atol=1e-6)
    jax.tree.map(same, seen.anchors[:-1], without.anchors)
    assert seen.anchors[-1].features is None and seen.anchors[-1].offset.shape == (150, 3)
    with pytest.raises(ValueError, match="2 levels of anchors"):
        check_embedding(prior, without, "test")


def test_points_beside_those_of_the_encoder_are_read(prior, cloud):
    """Those behind the encoder's own alone, moved, change distances and no code."""
    points, normals = cloud
    embedding = placed(prior, points, jnp.ones(len(points), bool), normals)
    last = embedding.anchors[-1]
    behind = jnp.arange(150)[:, None] >= prior.config.encoder.points
    moved = dataclasses.replace(last, offset=jnp.where(behind, 1.1 * last.offset, last.offset))
    other = dataclasses.replace(embedding, anchors=(*embedding.anchors[:-1], moved))
    q = 1.2 * points[:40]
    assert np.abs(field(prior, other, q) - field(prior, embedding, q)).max() > 1e-3


@pytest.mark.slow
def test_gradients_are_finite_with_few_points_and_one_normal(prior, cloud):
    points = cloud[0]
    mask, normals = jnp.arange(len(points)) < 20, jnp.zeros_like(points).at[0, 2].set(1.0)

    def total(params, points, normals):
        weights = dataclasses.replace(prior, params=params)
        return jnp.abs(sdf_one(weights, encode_one(weights, points, mask, normals), points[:30])).sum()

    gradient = jax.device_get(jax.jit(jax.grad(total, argnums=(0, 1, 2)))(prior.params, points, normals))
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(gradient))
    assert np.abs(gradient[0]["decoder"]["surface"]["log_bandwidth"]).min() > 0


@pytest.mark.slow
def test_a_decoder_that_begins_to_see_the_surface_says_what_it_said(cloud, tmp_path):
    own = random_prior(model(surface_points=0, normals=False))
    save_prior(own, tmp_path / "plain.npz", half=False)
    begun = started_warm(model(), str(tmp_path / "plain.npz"), "mine")
    assert begun.config == model()
    e, old = (placed(p, cloud[0], jnp.ones(len(cloud[0]), bool), cloud[1]) for p in (begun, own))
    q = 1.2 * cloud[0][:40]
    expected = field(own, old, q)
    assert np.ptp(expected) > 1e-3
    np.testing.assert_allclose(field(begun, e, q), expected, atol=1e-6)
    save_prior(begun, tmp_path / "seeing.npz")
    with pytest.raises(ValueError, match="its decoder is"):  # not the other way
        started_warm(model(surface_points=0), str(tmp_path / "seeing.npz"), "mine")


def test_settings_are_stored_with_the_weights_and_a_bare_decoder_sees_none_of_it(prior, cloud, tmp_path):
    save_prior(prior, tmp_path / "seen.npz", half=False)
    assert load_prior(tmp_path / "seen.npz").config == prior.config
    assert not without_normals(prior.config).decoder.surface_points
    both = random_prior(dataclasses.replace(prior.config, bare_decoder=True))
    points, q = cloud[0], 1.2 * cloud[0][:40]
    bare = dataclasses.replace(
        both,
        params={"encoder": both.params["encoder"], "decoder": both.params["bare_decoder"]},
        config=without_normals(both.config),
    )
    e, own = (placed(p, points, jnp.ones(len(points), bool)) for p in (both, bare))
    np.testing.assert_allclose(field(both, e, q), field(bare, own, q), atol=2e-6)
