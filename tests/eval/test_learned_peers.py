"""Decoders of the decoding study and the classifier: laws of turning, and both programs from shards to figures."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_scenes import known_scene
from scipy.spatial.transform import Rotation
from sphere_shards import sphere_shards

from eval import decoding
from eval.peers import classifier
from eval.peers.learned_decoders import VARIANTS, decoder_of, frame_of, loss_of, start
from more2_jax.network.prior import load_prior, save_prior
from more2_jax.types import Embedding
from train.run.settings import TrainingConfig

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
    weights, decoder = start(tiny_prior, e, 0)[name], decoder_of(tiny_prior, VARIANTS[name])
    here = np.asarray(decoder.apply(weights, e, points))
    there = np.asarray(decoder.apply(weights, turned(e, R), (points @ R.T).astype(np.float32)))
    np.testing.assert_allclose(there, here, atol=2e-4 * max(1, np.abs(here).max()))
    assert np.ptp(here) > 0


def test_losses_are_least_where_they_should_be():
    truth = jnp.array([[-0.2, 0.3]])
    distance, occupancy = VARIANTS["inner, MLP"], VARIANTS["VN-ONet (inner, MLP, occupancy)"]
    assert float(loss_of(distance, truth, truth, TrainingConfig())) == 0
    sure, wrong = (
        float(loss_of(occupancy, s * 30 * jnp.sign(truth), truth, TrainingConfig())) for s in (1, -1)
    )
    assert sure < 1e-6 and wrong > 20


@pytest.mark.slow
def test_decoders_are_trained_and_scored(tmp_path, tiny_prior):
    (tmp_path / "shards").mkdir()
    shards = sphere_shards(tmp_path / "shards")
    save_prior(tiny_prior, tmp_path / "tiny.npz")
    (tmp_path / "small.yaml").write_text(SMALL)
    decoding.main(
        (shards,),
        tmp_path / "out",
        prior=str(tmp_path / "tiny.npz"),
        config=tmp_path / "small.yaml",
        steps=2,
        views=(1,),
        split="val",
        points=100,
        most=3,
    )
    rows = json.loads((tmp_path / "out" / "1_views" / "results.json").read_text())["rows"]
    overall = {(r["method"], r["name"]): r for r in rows if r["group"] == "all"}
    assert {m for m, _ in overall} == {*VARIANTS, decoding.OWN}
    assert all(r["count"] == 3 and 0 <= r["value"] <= 100 for r in overall.values() if r["unit"] == "%")
    assert not any(m.startswith("VN-ONet") and n.startswith("error") for m, n in overall)


def test_a_perfect_field_scores_one_and_its_negative_zero():
    near = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
    truth = dict(zip(map(tuple, near[:, :3].tolist()), near[:, 3].tolist(), strict=True))

    def field(points):
        return jnp.array([truth[tuple(p)] for p in np.asarray(points).tolist()])

    right = decoding.scores_of(field, near, near, decoding.OWN)
    assert (float(right["sign"]), float(right["iou"]), float(right["error"])) == (1, 1, 0)
    wrong = decoding.scores_of(lambda p: -field(p), near, near, decoding.OWN)
    assert (float(wrong["sign"]), float(wrong["iou"])) == (0, 0) and float(wrong["error"]) > 0


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
