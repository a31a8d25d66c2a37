"""Decoders of the decoding study turn along with their objects; the classifier, from shards to matches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_scenes import known_scene
from scipy.spatial.transform import Rotation
from sphere_shards import sphere_shards

from eval.peers import classifier
from eval.peers.decoder_training import decoder_weights, distances
from eval.peers.learned_decoders import VARIANTS, frame_of
from more2_jax.network.prior import load_prior
from more2_jax.types import Embedding

SMALL = """
model:
  encoder:
    {widths: [4, 4, 8, 8, 8, 8, 8], code: 6, neighbors: 4, head_channels: 4, downsample_factors: [2, 2, 2], points: 64}
  decoder: {hidden: 16, layers: 3, skip_layer: 1, dropout: 0.0, narrow_skip: false}
training: {batch: 4, queries: 16, raw_points: 64, max_views: 2, warmup_steps: 1}
"""


def code(channels, seed=0):
    rng = np.random.default_rng(seed)
    inv, eqv = rng.normal(size=channels), rng.normal(size=(3, channels))
    return Embedding(
        inv=(0.1 * inv / np.linalg.norm(inv)).astype(np.float32),
        eqv=(0.1 * eqv / np.linalg.norm(eqv)).astype(np.float32),
        scale=np.float32(0.7),
        center=rng.normal(size=3).astype(np.float32),
        origin=np.zeros(3, np.float32),
    )


def turned(e, R):
    return Embedding(
        inv=e.inv,
        eqv=(R @ e.eqv).astype(np.float32),
        scale=e.scale,
        center=(R @ e.center).astype(np.float32),
        origin=e.origin,
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_frame_is_a_rotation_that_turns_along(seed):
    rng = np.random.default_rng(seed)
    eqv, weights, R = rng.normal(size=(3, 5)), rng.normal(size=(5, 2)), Rotation.random(rng=rng).as_matrix()
    here, there = (np.asarray(frame_of(jnp.asarray(x), jnp.asarray(weights))) for x in (eqv, R @ eqv))
    np.testing.assert_allclose(here.T @ here, np.eye(3), atol=1e-5)
    assert np.linalg.det(here) == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose(there, R @ here, atol=1e-5)


def test_a_frame_of_nothing_is_finite():
    assert np.isfinite(np.asarray(frame_of(jnp.zeros((3, 5)), jnp.ones((5, 2))))).all()


@pytest.mark.parametrize("name", VARIANTS)
def test_values_do_not_change_when_object_and_queries_turn(name, tiny_prior):
    e = code(tiny_prior.config.encoder.code)
    R = Rotation.random(random_state=3).as_matrix()
    points = np.random.default_rng(1).normal(size=(20, 3)).astype(np.float32)
    config, variant = tiny_prior.config, VARIANTS[name]
    weights = {"decoder": decoder_weights(config, variant, e, 0)}
    here = np.asarray(distances(config, variant, weights, e, points))
    there = np.asarray(distances(config, variant, weights, turned(e, R), (points @ R.T).astype(np.float32)))
    np.testing.assert_allclose(there, here, atol=2e-4 * max(1, np.abs(here).max()))
    assert np.ptp(here) > 0


@pytest.mark.slow
def test_a_classifier_is_trained_and_matches_copies(tmp_path):
    (tmp_path / "shards").mkdir()
    shards = sphere_shards(tmp_path / "shards")
    names, labels = classifier.categories([shards])
    assert names == ["ball 0", "ball 1"] and len(labels) == 32 and set(labels) == {0, 1}
    (tmp_path / "small.yaml").write_text(SMALL)
    classifier.main(tmp_path / "small.yaml", (shards,), tmp_path / "classifier.npz", steps=3)
    trained = load_prior(tmp_path / "classifier.npz")
    assert trained.name == "classifier" and all(
        np.isfinite(leaf).all() for leaf in jax.tree.leaves(trained.params)
    )
    instances = known_scene().scans[0].instances
    matched = classifier.classifier(tmp_path / "classifier.npz", 4)(instances, instances[::-1])
    assert matched == {i.id: i.id for i in instances}
