"""The decoding study: all decoders are trained with an encoder of their own, for equal steps, and meshes are scored.

A layer stands in for the encoder and views for samples with flaws: steps of the real ones take minutes to compile.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sphere_shards import sphere_shards

from eval import decoding
from eval.peers import decoder_training
from eval.peers.decoder_training import Study, trained
from eval.peers.learned_decoders import VARIANTS
from more2_jax.config import DecoderConfig, EncoderConfig, PriorConfig
from more2_jax.meshing.grid import cube
from more2_jax.network.prior import Prior
from more2_jax.types import Embedding
from train.run.batches import resident
from train.run.devices import device_mesh
from train.run.settings import TrainingConfig, TrainingRun
from train.run.shape_mix import open_mix
from train.shards.sampling import TrainingSample

CODE = 6
SOME = {name: VARIANTS[name] for name in ("inner, DeepSDF", "inv, MLP")}
MODEL = PriorConfig(
    encoder=EncoderConfig(code=CODE, points=32),
    decoder=DecoderConfig(hidden=16, layers=3, skip_layer=1, dropout=0.0, narrow_skip=False, local_blocks=()),
)
TRAINING = TrainingConfig(
    steps=6, batch=4, queries=16, raw_points=64, max_views=2, warmup_steps=1, validate_every=2
)
SETTINGS = TrainingRun(model=MODEL, training=TRAINING)


def one_layer(prior, points, mask, normals=None, train=False):
    """An encoder of one layer: sums of offsets from the center, weighted by how far off they are."""
    center = points.mean(axis=0)
    offset = points - center
    length = jnp.linalg.norm(offset, axis=1, keepdims=True)
    eqv = offset.T @ jnp.sin(length * prior.params["encoder"]["frequency"]) / len(points)
    scale = jnp.exp(prior.params["encoder"]["size"]) * length.mean()
    return Embedding(inv=(eqv**2).sum(axis=0), eqv=eqv, scale=scale, center=center)


def two_views(shapes, index, step, model, config, mesh):
    """Of every shape two clouds without flaws, and the same queries at every step."""
    points = shapes.views[index][:, :2, : model.encoder.points].astype(jnp.float32)
    asked = shapes.sdf_uniform[index][:, None, : config.queries].astype(jnp.float32)
    asked = jnp.broadcast_to(asked, (len(index), 2, config.queries, 4))
    mask = jnp.ones(points.shape[:-1], bool)
    sample = TrainingSample(
        points=points,
        normals=jnp.zeros_like(points),
        mask=mask,
        queries=asked[..., :3],
        sdf=asked[..., 3],
    )
    return sample, jax.random.key(0)


@pytest.fixture
def start(monkeypatch):
    monkeypatch.setattr(decoder_training, "draw", two_views)
    for module in (decoder_training, decoding):
        monkeypatch.setattr(module, "encode_ordered", one_layer)
        monkeypatch.setattr(module, "VARIANTS", SOME)
    weights = {"frequency": jnp.linspace(1.0, 9.0, CODE), "size": jnp.zeros(())}
    start = Prior(params={"encoder": weights}, config=MODEL)
    monkeypatch.setattr(decoding, "started_cold", lambda *_: start)
    return start


@pytest.fixture
def shards(tmp_path):
    (tmp_path / "shards").mkdir()
    return sphere_shards(tmp_path / "shards")


def study_in(folder, start, shards):
    mesh = device_mesh(TRAINING.batch)
    batches = resident(open_mix((shards,), "train"), TRAINING, mesh)
    return Study(training=TRAINING, start=start, batches=batches, mesh=mesh, out=folder)


@pytest.mark.slow
def test_every_decoder_trains_an_encoder_of_its_own_and_a_stopped_run_is_the_run_that_was_not(
    tmp_path, start, shards
):
    whole, steps = trained(study_in(tmp_path / "whole", start, shards), math.inf)
    assert steps == TRAINING.steps and set(whole) == set(SOME)
    moved = [np.asarray(w["encoder"]["frequency"]) for w in whole.values()]
    assert all(np.abs(m - start.params["encoder"]["frequency"]).max() > 1e-4 for m in moved)
    assert all(np.abs(a - b).max() > 1e-6 for a, b in itertools.combinations(moved, 2))

    study = study_in(tmp_path / "parts", start, shards)

    def three(step):
        yield from itertools.islice(study.batches(step), 3)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trained(dataclasses.replace(study, batches=three), math.inf)
    _, steps = trained(study, time.monotonic() - 1)  # no time left: the checkpoint, as it is
    assert steps == TRAINING.validate_every
    resumed, steps = trained(study, math.inf)
    assert steps == TRAINING.steps
    jax.tree.map(np.testing.assert_array_equal, resumed, whole)


def test_from_shards_to_figures(tmp_path, start, shards, monkeypatch):
    monkeypatch.setattr(decoding, "load_config", lambda *_: SETTINGS)
    decoding.main((shards,), tmp_path / "out", views=(2,), resolution=8, most=3)
    rows = json.loads((tmp_path / "out" / "2_views" / "results.json").read_text())["rows"]
    found = {(r["method"], r["name"]): r for r in rows}
    assert {m for m, _ in found} == {*SOME, decoding.TRUTH}
    for name in SOME:
        uniform = found[name, "L1 of uniform queries"]
        assert uniform["count"] == 3 and uniform["value"] > 0 and len(uniform["ci95"]) == 2
        assert {f.name for f in decoding.FIGURES} == {n for m, n in found if m == name}


def test_records_of_fewer_steps_are_forgotten_and_others_stay(tmp_path):
    for steps, kept in ((2, False), (2, True), (4, False)):
        folder = decoding.opened_folder(tmp_path / "out", {"steps": steps}, [None])
        assert (folder.missing() == []) == kept
        folder.file("0000").write_text("[]")


def sphere(radius, shift=0.0):
    """Distances to a sphere on a grid, and points on it."""
    lattice = cube(24, 0.55)
    corners = lattice.corners()
    grid = np.linalg.norm(corners - [shift, 0, 0], axis=1) - radius
    unit = np.random.default_rng(0).normal(size=(20_000, 3))
    return grid.reshape(lattice.shape), lattice, radius * unit / np.linalg.norm(unit, axis=1, keepdims=True)


def test_the_chamfer_distance_of_spheres_is_that_of_their_surfaces():
    grid, lattice, points = sphere(0.3)
    exact = decoding.mesh_chamfer(grid, lattice, points)
    assert exact is not None and exact < 0.005  # the spacing of the points
    larger = decoding.mesh_chamfer(grid - 0.1, lattice, points)
    assert larger == pytest.approx(0.1, abs=0.003)
    # Of a shift by d, the mean distance is that of ‖p − d·x‖ to the radius.
    shifted = decoding.mesh_chamfer(sphere(0.3, shift=0.1)[0], lattice, points)
    assert shifted == pytest.approx(0.05, abs=0.004)


def test_a_field_without_a_level_has_no_mesh():
    grid, lattice, points = sphere(0.3)
    assert decoding.mesh_chamfer(np.abs(grid) + 0.01, lattice, points) is None
    assert decoding.mesh_chamfer(grid - 9.0, lattice, points) is None


def test_a_perfect_field_scores_one_and_its_negative_zero():
    truth = np.random.default_rng(0).normal(size=50)
    right = decoding.field_scores(truth, truth, truth, truth)
    assert right == {"uniform": 0, "near": 0, "sign": 1, "iou": 1}
    wrong = decoding.field_scores(-truth, truth, -truth, truth)
    assert (wrong["sign"], wrong["iou"]) == (0, 0)
    assert wrong["uniform"] == wrong["near"] == pytest.approx(2 * np.abs(truth).mean())
    constant = decoding.field_scores(truth + 0.25, truth, truth + 0.5, truth)
    assert (constant["near"], constant["uniform"]) == (pytest.approx(0.25), pytest.approx(0.5))
