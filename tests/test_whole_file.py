"""What was there stays until the new file is complete."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from factories import living_scene
from places import ROOT

from more2_jax.export import export_scene
from more2_jax.network.prior import load_prior, save_prior
from more2_jax.whole_file import whole_file

KILLED_HALF_WAY = """
import os, signal, sys
from more2_jax.whole_file import whole_file
with whole_file(sys.argv[1]) as partial:
    partial.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_the_new_file_takes_the_place_of_the_old_one(tmp_path):
    path = tmp_path / "poses.json"
    path.write_text("old")
    with whole_file(path) as partial:
        partial.write_text("new")
        assert path.read_text() == "old" and partial.suffix == ".json"
    assert path.read_text() == "new"
    assert os.listdir(tmp_path) == ["poses.json"]


def write_half(path):
    with whole_file(path) as partial:
        partial.write_text("half")
        raise OSError("disk full")


@pytest.mark.parametrize("there", [True, False])
def test_an_error_leaves_what_was_there_and_nothing_beside(tmp_path, there):
    path = tmp_path / "poses.json"
    if there:
        path.write_text("old")
    with pytest.raises(OSError, match="disk full"):
        write_half(path)
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == ({"poses.json": "old"} if there else {})


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
def test_after_a_kill_the_old_file_is_there_and_the_next_attempt_tidies(tmp_path):
    path = tmp_path / "poses.json"
    path.write_text("old")
    killed = subprocess.run([sys.executable, "-c", KILLED_HALF_WAY, str(path)], cwd=ROOT)
    assert killed.returncode == -signal.SIGKILL
    assert path.read_text() == "old"
    assert len(os.listdir(tmp_path)) == 2
    with whole_file(path) as partial:
        partial.write_text("new")
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {"poses.json": "new"}


@pytest.mark.parametrize("format", ["glb", "ply", "json"])
def test_an_export_that_fails_leaves_the_one_before(tmp_path, monkeypatch, format):
    path = export_scene(living_scene(), tmp_path / f"room.{format}", format)
    before = path.read_bytes()

    def fails(scene, path, scan):
        path.write_bytes(before[: len(before) // 2])
        raise OSError("disk full")

    monkeypatch.setitem(sys.modules["more2_jax.export"].WRITERS, format, fails)
    with pytest.raises(OSError, match="disk full"):
        export_scene(living_scene(), path, format)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == [path.name]


def test_weights_that_cannot_be_written_leave_the_ones_before(tmp_path, monkeypatch, tiny_prior):
    path = tmp_path / "best.npz"
    save_prior(tiny_prior, path)
    before = path.read_bytes()

    def fails(file, **arrays):
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", fails)
    with pytest.raises(OSError, match="disk full"):
        save_prior(tiny_prior, path)
    assert path.read_bytes() == before
    assert load_prior(path).name == tiny_prior.name
