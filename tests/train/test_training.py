"""Losses by definition; a training run that is stopped and resumed is the run that was not stopped."""

from __future__ import annotations

import dataclasses
import platform
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from places import ROOT
from sphere_shards import sphere_shards

from more2_jax.config import load_config
from more2_jax.network.prior import init_prior
from train.run.journal import Journal, read_log
from train.run.pictures import EYE, PIXELS, held_out, splat
from train.run.schedule import learning_rate
from train.run.settings import TrainingRun
from train.run.shape_mix import load_mix
from train.run.start import started_warm
from train.shards.losses import (
    LEAST_CORRELATION,
    contrast_loss,
    rotation_loss,
    scale_loss,
    sdf_loss,
    sign_loss,
    total_loss,
    turn_loss,
    up_loss,
)
from train.shards.packed_shapes import read_shapes
from train.shards.sampling import sample_batch
from train.shards.shards import open_shards
from train.tools import pack


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    return sphere_shards(tmp_path_factory.mktemp("shards"))


@pytest.fixture(scope="module")
def run():
    return load_config(ROOT / "configs" / "tiny.yaml", TrainingRun)


@pytest.mark.slow
@pytest.mark.parametrize("normals", [False, True])
def test_a_picture_shows_what_was_seen_and_the_whole_beside_the_mesh(shards, run, normals):
    decoder = dataclasses.replace(run.model.decoder, normals=normals)
    prior = init_prior(dataclasses.replace(run.model, decoder=decoder), jax.random.key(0))
    shapes = load_mix([shards], "val")[0]
    drawn = held_out(prior, shapes, run.training, 2)
    assert drawn.shape == (2 * PIXELS, 3 * PIXELS, 3)
    inked = (drawn < 255).any(axis=-1).reshape(2, PIXELS, 3, PIXELS).sum(axis=(1, 3))
    assert (inked[:, 2] > inked[:, 0]).all() and (inked[:, 0] > 0).all()


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


def test_scale_loss_is_zero_at_one_and_the_logarithm_pulls_a_vanishing_scale():
    for error in ("log", "absolute"):
        assert scale_loss(jnp.ones(3), error) == 0
        above, below = (float(jax.grad(lambda s, e=error: scale_loss(s, e))(x)) for x in (1.001, 0.999))
        np.testing.assert_allclose([above, below], [1, -1], rtol=2e-3)
    np.testing.assert_allclose(scale_loss(jnp.array([0.5, 2.0]), "absolute"), 0.75)
    slope = jax.grad(lambda s: scale_loss(s, "log"))
    assert float(slope(1e-3)) == pytest.approx(-1e3, rel=1e-4)


def test_up_loss_is_zero_where_the_first_third_points_up_and_one_where_it_says_nothing():
    up = jnp.zeros((1, 2, 3, 6)).at[..., 2, :2].set(6**-0.5)
    np.testing.assert_allclose(up_loss(up), 0.0, atol=1e-12)
    np.testing.assert_allclose(up_loss(-up), 4.0, rtol=1e-6)
    np.testing.assert_allclose(up_loss(jnp.zeros((1, 2, 3, 6))), 1.0)


def test_rotation_loss_is_zero_only_where_kabsch_finds_the_identity_and_no_turn_is_left_open():
    whole = jnp.eye(3)[None] / jnp.sqrt(3.0)
    turned = jnp.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ whole
    one_axis = jnp.zeros((1, 3, 3)).at[0, 2, 2].set(1.0)
    none = LEAST_CORRELATION**2
    for second, expected in ((whole, 0.0), (turned, 2 / 3), (-whole, 2.0)):
        loss = rotation_loss(jnp.stack([whole, second], axis=1))
        np.testing.assert_allclose(1 - (1 - expected) / np.sqrt(1 + 3 * none), loss, atol=1e-6)
    loss = rotation_loss(jnp.stack([one_axis, one_axis], axis=1))
    np.testing.assert_allclose(loss, 1 - 1 / np.sqrt(3 * (1 + none)), rtol=1e-6)
    assert turn_loss(jnp.stack([one_axis, one_axis], axis=1)) == 0


@pytest.mark.parametrize("change", ["encoder", "decoder"])
def test_a_warm_start_from_another_model_is_refused_in_one_line(run, change):
    model = run.model
    other = {"encoder": {"code": 32}, "decoder": {"hidden": 32}}[change]
    other = dataclasses.replace(model, **{change: dataclasses.replace(getattr(model, change), **other)})
    with pytest.raises(ValueError, match="--warm-start small: its encoder is"):
        started_warm(other, "small", "mine")


def test_gradients_of_the_training_loss_are_finite(shards, run, tiny_prior):
    draw = jax.jit(sample_batch, static_argnames=("config", "points"))
    sample = draw(jax.random.key(0), load_mix([shards], "train")[0], jnp.arange(4), run.training, points=64)

    @jax.jit
    @jax.grad
    def loss(params, sample):
        prior = dataclasses.replace(tiny_prior, params=params)
        return total_loss(prior, sample, run.training, jax.random.key(1))[0]

    gradient = jax.tree.leaves(jax.device_get(loss(tiny_prior.params, sample)))
    assert all(np.isfinite(g).all() for g in gradient)
    assert any(np.abs(g).max() > 0 for g in gradient)


def test_the_published_schedule_drops_thrice_and_the_cosine_ends_at_a_hundredth(run):
    training = dataclasses.replace(run.training, steps=1000, warmup_steps=100, learning_rate=1.0)
    steps = learning_rate(dataclasses.replace(training, schedule="steps"))
    at = [float(steps(n)) for n in (0, 50, 100, 598, 602, 752, 902, 999)]
    np.testing.assert_allclose(at, [0, 0.5, 1, 1, 0.3, 0.09, 0.027, 0.027], rtol=1e-5)
    cosine = learning_rate(training)
    np.testing.assert_allclose([float(cosine(n)) for n in (0, 100, 1000)], [0, 1, 0.01], rtol=1e-5)


def test_a_trapezoid_may_be_given_other_steps_while_it_is_flat(run):
    training = dataclasses.replace(
        run.training, schedule="trapezoid", steps=1000, warmup_steps=100, learning_rate=1.0
    )
    short, long = learning_rate(training), learning_rate(dataclasses.replace(training, steps=5000))
    at = [float(short(n)) for n in (0, 50, 100, 800, 900, 1000, 1200)]
    np.testing.assert_allclose(at, [0, 0.5, 1, 1, 0.505, 0.01, 0.01], rtol=1e-5)
    assert [float(short(n)) for n in range(0, 801, 50)] == [float(long(n)) for n in range(0, 801, 50)]
    np.testing.assert_allclose([float(long(n)) for n in (4000, 4500, 5000)], [1, 0.505, 0.01], rtol=1e-5)


def test_packed_shapes_are_the_shards_to_within_a_step(shards, tmp_path):
    packed = tmp_path / "small.npz"
    pack.main((shards,), packed, shapes=10, val=4, views=2, points=32, queries=50)
    small, whole = read_shapes(packed, "train"), load_mix([shards], "train")[0]
    assert small.views.shape == (10, 2, 32, 3) and small.sdf_near.shape == (10, 50, 4)
    # Every packed shape is one of the shards', cut and rounded.
    cut = np.asarray(whole.views[:, :2, :32], np.float64)
    off = np.abs(cut[None] - np.asarray(small.views, np.float64)[:, None]).max(axis=(2, 3, 4))
    assert (off.min(axis=1) < 0.0035).all() and (np.sort(off, axis=1)[:, 1] > 0.0035).all()
    source = off.argmin(axis=1)
    np.testing.assert_allclose(
        np.asarray(whole.sdf_near[source, :50], np.float64), np.asarray(small.sdf_near, np.float64), atol=6e-4
    )
    with pytest.raises(ValueError, match="no test/views"):
        read_shapes(packed, "test")


def test_packed_shapes_name_every_mesh_and_its_license(shards, tmp_path):
    pack.main((shards, shards), tmp_path / "small.npz", shapes=10**6, val=10**6, views=1, points=4, queries=4)
    head, *rows = (line.split("\t") for line in (tmp_path / "small.credits.tsv").read_text().splitlines())
    assert head == ["name", "source", "license"]
    kept = [open_shards(shards, split).meta for split in ("train", "val")]
    assert [r[0] for r in rows] == sorted(m["name"] for meta in kept for m in meta)
    assert all(text for row in rows for text in row)


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 and no more"])
def test_a_damaged_pack_is_refused_in_one_line(tmp_path, damage):
    (tmp_path / "bad.npz").write_bytes(damage)
    with pytest.raises(ValueError, match="not a readable"):
        read_shapes(tmp_path / "bad.npz", "train")


def test_a_source_named_twice_is_held_once_and_drawn_twice_as_often(shards, tmp_path):
    packed = tmp_path / "small.npz"
    pack.main((shards,), packed, shapes=5, val=2, views=4, points=64, queries=30)
    shapes, rows = load_mix((shards, packed, shards), "train")
    assert len(shapes.views) == 32 + 5
    assert sorted(np.bincount(rows)) == [1] * 5 + [2] * 32


def test_rows_of_a_smaller_source_are_repeated(shards, tmp_path):
    packed = tmp_path / "small.npz"
    pack.main((shards,), packed, shapes=5, val=2, views=3, points=20, queries=30)
    shapes, _ = load_mix((shards, packed), "train")
    alone, _ = load_mix((packed,), "train")
    views, points = open_shards(shards, "train")[0]["views"].shape[:2]
    assert views > 3 and points > 20 and shapes.views.shape == (37, views, points, 3)
    for v in range(views):
        np.testing.assert_array_equal(
            shapes.views[32:, v], np.asarray(alone.views)[:, v % 3, np.arange(points) % 20]
        )
    queries = np.arange(shapes.sdf_near.shape[1]) % 30
    np.testing.assert_array_equal(shapes.sdf_near[32:], np.asarray(alone.sdf_near)[:, queries])


def test_a_resumed_log_forgets_what_was_lost_and_what_was_half_written(tmp_path):
    with Journal(tmp_path, 0) as journal:
        for step, score in ((10, 0.5), (20, 0.9), (30, 0.7)):
            journal.write(step, float(step), {"sdf": 0.1}, {"score": score})
    log = tmp_path / "log.jsonl"
    log.write_text(log.read_text() + '{"step": 40, "sec')
    with Journal(tmp_path, 10) as journal:
        assert (journal.best, journal.seconds) == (0.5, 10.0)
        journal.write(20, 21.0, {"sdf": 0.1}, {"score": 0.6})
    assert [line["step"] for line in read_log(log)] == [10, 20]
    assert Journal(tmp_path, 20).best == 0.6


def test_nearer_points_hide_farther_ones():
    near, far = EYE[2] * 0.3, -EYE[2] * 0.3
    both = [splat(np.array(p), None, 1) for p in ([near, far], [far, near])]
    np.testing.assert_array_equal(both[0], both[1])
    np.testing.assert_array_equal(both[0], splat(near[None], None, 1))
    # What lies outside of the picture is left out.
    assert (splat(np.array([[50.0, 0, 0]]), None, 1) == 255).all()


FAULTS = """
import resource, sys
from train.run.memory import keep_freed_memory
assert sys.argv[1] == "as it is" or keep_freed_memory()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(40):
    bytearray(40_000_000)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other allocators have no mallopt")
def test_freed_memory_is_taken_again_instead_of_mapped_anew():
    def faults(how: str) -> int:
        command = [sys.executable, "-c", FAULTS, how]
        return int(subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout)

    assert faults("kept") < faults("as it is") / 5
