"""Batches from memory and from disk are the same shapes; which ones depends on the seed and the step alone."""

import dataclasses
import itertools
import json
import subprocess
import sys

import jax
import numpy as np
import pytest
import yaml
from jax.sharding import Mesh
from places import ROOT
from sphere_shards import sphere_shards

from train import prior
from train.run.batches import batches_of, chosen, resident, streamed
from train.run.devices import ROWS
from train.run.memory import memory_bytes
from train.run.settings import TrainingConfig
from train.run.shape_mix import open_mix
from train.tools import pack

CONFIG = TrainingConfig(steps=50, batch=4, queries=32, raw_points=64, max_views=3, seed=5)
MESH = Mesh(np.array(jax.devices()[:1]), (ROWS,))


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    return sphere_shards(tmp_path_factory.mktemp("shards"))


@pytest.fixture(scope="module")
def mix(shards, tmp_path_factory):
    """A folder of 32 shapes, a packed file of 5 of them, and the folder again."""
    packed = tmp_path_factory.mktemp("packed") / "small.npz"
    pack.main((shards,), packed, shapes=5, val=2, views=4, points=64, queries=30)
    return open_mix((shards, packed, shards), "train")


def drawn(batches, step, count):
    """The shapes of `count` steps from `step` on."""
    found = itertools.islice(batches(step), count)
    return [jax.tree.map(lambda a, index=index: np.asarray(a[index]), shapes) for shapes, index in found]


def same(first, second):
    jax.tree.map(np.testing.assert_array_equal, first, second)


def test_from_disk_come_the_shapes_that_memory_holds(mix):
    from_memory = drawn(resident(mix, CONFIG, MESH), 0, 8)
    same(from_memory, drawn(streamed(mix, CONFIG, MESH), 0, 8))
    assert from_memory[0].views.shape == (4, 4, 64, 3) and from_memory[0].sdf_near.shape == (4, 200, 4)
    assert not np.array_equal(from_memory[0].views, from_memory[1].views)


@pytest.mark.parametrize("way", [resident, streamed])
def test_a_resumed_run_sees_what_it_would_have_seen(mix, way):
    batches = way(mix, CONFIG, MESH)
    same(drawn(batches, 0, 7)[5:], drawn(batches, 5, 2))


def test_a_step_draws_the_rows_as_often_as_they_stand_there(mix):
    drawn_rows = np.concatenate([chosen(mix.rows, CONFIG, step) for step in range(6000)])
    often = np.bincount(drawn_rows, minlength=len(mix)) / len(drawn_rows)
    np.testing.assert_allclose(often[:32], 2 / 69, atol=0.006)
    np.testing.assert_allclose(often[32:], 1 / 69, atol=0.005)
    other = chosen(mix.rows, dataclasses.replace(CONFIG, seed=6), 0)
    assert not np.array_equal(chosen(mix.rows, CONFIG, 0), other)


def test_what_is_too_large_for_memory_is_read_from_disk(mix):
    whole = mix.read(range(len(mix)))
    assert mix.nbytes == sum(array.nbytes for array in vars(whole).values())
    shapes, _ = next(batches_of(mix, CONFIG, MESH, mix.nbytes)(0))
    assert len(shapes.views) == len(mix) == 37
    shapes, _ = next(batches_of(mix, CONFIG, MESH, mix.nbytes - 1)(0))
    assert len(shapes.views) == CONFIG.batch


def test_memory_is_that_of_a_machine():
    assert 2**28 < memory_bytes() < 2**50


@pytest.mark.slow
def test_a_run_has_the_same_losses_either_way(shards, tmp_path):
    settings = yaml.safe_load((ROOT / "configs" / "tiny.yaml").read_text())
    settings["training"] |= {"steps": 4, "validate_every": 2}
    (tmp_path / "few.yaml").write_text(yaml.safe_dump(settings))
    for share, out in ((1.0, "memory"), (0.0, "disk")):
        prior.main(tmp_path / "few.yaml", (shards,), tmp_path / out, resident_share=share)
    memory, disk = (
        [json.loads(line) for line in (tmp_path / out / "log.jsonl").read_text().splitlines()]
        for out in ("memory", "disk")
    )
    assert [line["step"] for line in memory] == [line["step"] for line in disk] == [2, 4]
    for a, b in zip(memory, disk, strict=True):
        assert a["train"] == pytest.approx(b["train"], rel=1e-5)
        assert a["val"] == pytest.approx(b["val"], rel=1e-4)


def test_without_grain_one_line_names_the_extra(mix, monkeypatch):
    monkeypatch.setitem(sys.modules, "grain.python", None)
    with pytest.raises(ValueError, match=r"more2-jax\[train\]"):
        streamed(mix, CONFIG, MESH)


def test_training_can_be_imported_without_what_only_making_shards_needs():
    unwanted = {"grain", "point_cloud_utils", "embreex", "trimesh"}
    code = f"import sys; import train.prior; assert not {unwanted} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)
