"""Processes that are killed at random moments: some here, hundreds of whole ones by `python -m eval.survival`."""

import json
import os
import random
import signal
import time

import pytest
from factories import living_scene
from killed_commands import started, without_network

from eval import survival
from more2_jax.cli.main import main
from more2_jax.config import preset
from more2_jax.storage.scene_folder import save_scene

pytestmark = pytest.mark.skipif(os.name != "posix", reason="sends signals")


@pytest.mark.slow
def test_a_few_moments_of_run_and_add(tmp_path, capsys):
    survival.main(survival.Settings(out=tmp_path, moments=2, seed=1, commands=("run", "add")))
    told = json.loads((tmp_path / "results.json").read_text())
    moments = told["settings"]["moments"]
    assert [(m["command"], m["problem"]) for m in moments] == [("run", ""), ("add", "")]
    assert all(m["after_s"] > 0 for m in moments)
    found = {(r["name"], r["method"]): r["value"] for r in told["rows"]}
    assert found == {(name, c): 1 for c in ("run", "add") for name in ("moments", "right moments")}
    assert "2 of 2 moments right" in capsys.readouterr().out
    assert [p.name for p in tmp_path.iterdir()] == ["results.json"]


SECONDS = 60  # for a command that takes a tenth of one


@pytest.fixture(scope="module")
def place(tmp_path_factory, tiny_prior):
    """Scans, settings and weights, and the scene of two scans that `add` and `export` begin with."""
    found = survival.Place(folder=tmp_path_factory.mktemp("place"))
    found.prepare(tiny_prior)
    words = found.more2("run", found.folder / "two")
    with without_network(tiny_prior):
        assert main([w for w in words if not w.endswith("c.ply")]) == 0
    return found


@pytest.fixture
def here(tiny_prior):
    """A command in this process; what it was refused with."""

    def given(words):
        with without_network(tiny_prior):
            return f"exit code {code}" if (code := main(words)) else ""

    return given


@pytest.mark.parametrize("command", ["run", "add", "batch", "export"])
def test_killed_as_the_disk_changes_and_at_a_random_moment(place, here, command):
    """Every command, its method aside: what is on disk opens, and the same command ends with the same bytes."""
    scenes = survival.fresh(place, command, "whole")
    assert here(place.more2(command, scenes)) == ""
    expected = survival.content(scenes)

    def killed(at: int | None = None, after_s=SECONDS):
        scenes = survival.fresh(place, command, "killed")
        words = place.more2(command, scenes)
        process, told = started(words, at)
        process.join(after_s)
        process.kill()
        process.join(SECONDS)
        when = f"killed at change {at}, or after {after_s:.3f} s"
        assert survival.wrong_after(command, scenes, expected, lambda: here(words)) == "", when
        return process.exitcode, told

    began = time.perf_counter()
    code, told = killed()  # never; what is done is not done twice
    seconds, changes = time.perf_counter() - began, told.recv()
    assert code == 0
    opened, renamed = ([k for k, c in enumerate(changes) if c == kind] for kind in ("open", "os.rename"))
    for number in (opened[-1], *renamed[-2:]):  # the last file; the old scene goes out, the new one comes in
        assert killed(at=number)[0] == -signal.SIGKILL
    killed(after_s=random.uniform(0, seconds))


def test_what_is_compared_is_every_byte_but_of_what_tells_the_time(tmp_path):
    config = preset("robust", upright=True)
    save_scene(living_scene(), tmp_path / "room", config)
    before = survival.content(tmp_path)
    assert {"room/scene.json", "room/embeddings.npz", "room/config.yaml"} < set(before)
    save_scene(living_scene(), tmp_path / "room", config, log="other words")
    assert survival.content(tmp_path) == before
    (tmp_path / ".room.lock").touch()  # what is left beside a scene is seen
    assert survival.content(tmp_path) != before
    (tmp_path / ".room.lock").unlink()
    cloud = next((tmp_path / "room/objects").glob("*.ply"))
    cloud.write_bytes(cloud.read_bytes()[:-1] + b"\x01")
    assert survival.content(tmp_path) != before
    assert survival.scene_folders(tmp_path) == [tmp_path / "room"]
    (tmp_path / "room").rename(tmp_path / ".room.old")  # a swap cut short
    assert survival.scene_folders(tmp_path) == [tmp_path / "room"]
