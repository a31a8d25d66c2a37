"""Processes that are killed at random moments: a few here, hundreds by `python -m eval.survival`."""

import json
import os

import pytest
from factories import living_scene

from eval import survival
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
