"""Batches from disk: the same for (seed, step) however a run is cut up, over time or over processes."""

import itertools
import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from places import ROOT

from train.run.settings import TrainingConfig
from train.shards.loading import step_key, training_records, training_samples
from train.shards.sampling import sample_batch
from train.shards.shards import Shapes, open_shards

COUNT, BATCH, SEED = 10, 4, 5
CONFIG = TrainingConfig(queries=32, raw_points=64, max_views=3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two shards of five shapes of which shape i is views and queries at (i, ·, ·) / 16."""
    folder, rng = tmp_path_factory.mktemp("shards"), np.random.default_rng(0)
    for number in range(2):
        shard = folder / f"shard_{number:03d}"
        shard.mkdir()
        names = range(5 * number, 5 * number + 5)
        for name, rows in (("views", (24, 40, 3)), ("sdf_uniform", (300, 4)), ("sdf_near", (300, 4))):
            array = rng.uniform(-0.4, 0.4, (5, *rows))
            array[..., 0] = np.reshape(names, (5,) + (1,) * (len(rows) - 1)) / 16
            np.save(shard / f"{name}.npy", array.astype(np.float16))
        meta = [{"name": str(n), "category": "box", "source": "test", "split": "train"} for n in names]
        (shard / "meta.json").write_text(json.dumps(meta))
    return folder


def batches(folder, count, **changes):
    given = {"config": CONFIG, "points": 16, "seed": SEED, "batch": BATCH} | changes
    return list(itertools.islice(training_samples(folder, "train", **given), count))


def same(first, second):
    jax.tree.map(np.testing.assert_array_equal, first, second)


def test_a_batch_depends_on_seed_and_step_alone(folder):
    first = batches(folder, 4)
    same(first, batches(folder, 4, threads=1, ahead=1))
    assert not np.array_equal(first[0].queries, batches(folder, 1, seed=6)[0].queries)
    assert not np.array_equal(first[0].queries, first[1].queries)
    assert first[0].points.shape == (BATCH, 2, 16, 3)


@pytest.mark.parametrize("step", [1, 2, 7])  # within the first epoch, across its end, and later
def test_a_resumed_run_is_the_run_that_was_not_stopped(folder, step):
    whole = batches(folder, step + 2)
    same(whole[step:], batches(folder, 2, start_step=step))
    stopped = training_samples(folder, "train", CONFIG, 16, SEED, BATCH)
    for _ in range(step):
        next(stopped)
    state = json.loads(json.dumps(stopped.get_state()))
    assert state == {"next_index": step}
    resumed = training_samples(folder, "train", CONFIG, 16, SEED, BATCH)
    next(resumed)
    resumed.set_state(state)
    same(whole[step:], [next(resumed), next(resumed)])


def test_processes_joined_in_order_are_the_global_batch(folder):
    processes = 2
    parts = [batches(folder, 4, process_index=p, process_count=processes) for p in range(processes)]
    joined = [jax.tree.map(lambda *a: np.concatenate(a), *step) for step in zip(*parts, strict=True)]
    same(batches(folder, 4), joined)


def test_every_epoch_is_a_permutation_of_its_own(folder):
    records = training_records(open_shards(folder, "train"), CONFIG, SEED, 5)
    shapes = [records[s]["views"][1:, 0, 0, 0] * 16 for s in range(8)]  # four epochs of ten shapes
    epochs = np.concatenate(shapes).reshape(4, COUNT)
    np.testing.assert_array_equal(np.sort(epochs, axis=1), np.tile(np.arange(COUNT), (4, 1)))
    assert len({tuple(e) for e in epochs}) == 4


def test_the_loader_is_the_pure_sampler_on_what_was_read(folder):
    step = 3
    read = training_records(open_shards(folder, "train"), CONFIG, SEED, BATCH)[step]
    shapes = Shapes(**{n: jnp.asarray(read[n][1:]) for n in ("views", "sdf_uniform", "sdf_near")})
    sampler = jax.jit(sample_batch, static_argnames=("config", "points"))
    expected = sampler(step_key(SEED, step), shapes, jnp.arange(BATCH), CONFIG, 16)
    loaded = batches(folder, 1, start_step=step)[0]
    np.testing.assert_array_equal(loaded.mask, expected.mask)
    np.testing.assert_allclose(loaded.points, expected.points, atol=1e-6)
    np.testing.assert_allclose(loaded.sdf, expected.sdf, atol=1e-6)


def test_queries_are_rows_of_the_shape_of_their_cloud(folder):
    view = open_shards(folder, "train")
    stored = {
        tuple(np.float32(row))
        for i in range(COUNT)
        for n in ("sdf_uniform", "sdf_near")
        for row in view[i][n]
    }
    for batch in batches(folder, 3):
        assert (np.ptp(batch.queries[..., 0], axis=2) == 0).all()
        middle = np.nanmedian(np.where(batch.mask, batch.points[..., 0], np.nan), axis=2)
        np.testing.assert_allclose(middle, batch.queries[:, :, 0, 0], atol=0.03)
        rows = np.concatenate([batch.queries, batch.sdf[..., None]], axis=-1).reshape(-1, 4)
        assert {tuple(row) for row in rows} <= stored


def test_one_shape_is_a_collection_too(folder, tmp_path):
    shard = tmp_path / "shard_000"
    shard.mkdir()
    for name in ("views", "sdf_uniform", "sdf_near"):
        np.save(shard / f"{name}.npy", np.load(folder / "shard_000" / f"{name}.npy")[:1])
    (shard / "meta.json").write_text(json.dumps([{"name": "0", "split": "train"}]))
    assert np.isfinite(batches(tmp_path, 2)[1].points).all()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"batch": 5, "process_count": 2}, "batch 5 for 2 processes"),
        ({"batch": 0}, "batch 0"),
        ({"process_index": 2, "process_count": 2}, "process 2 of 2"),
        ({"seed": -1}, "seed -1"),
        ({"start_step": -1}, "start_step -1"),
        ({"threads": 0}, "threads 0"),
    ],
)
def test_what_does_not_fit_is_refused(folder, changes, reason):
    with pytest.raises(ValueError, match=reason):
        batches(folder, 1, **changes)


def test_no_shards_are_refused(tmp_path):
    with pytest.raises(ValueError, match="no shards"):
        batches(tmp_path, 1)


def test_without_grain_one_line_names_the_extra(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "grain.python", None)
    with pytest.raises(ValueError, match=r"more2-jax\[train\]"):
        batches(folder, 1)


def test_the_loader_can_be_imported_without_grain():
    code = "import sys; import train.shards.loading; assert 'grain' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)
