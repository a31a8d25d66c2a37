"""What version 0.1.0 stored opens unchanged: a living-scene folder, its settings, and the shipped weights.

The folder was written by that version's `save_scene` (without the page): two scans of small pieces in which one object
stays, one moves, one goes and one comes, with backgrounds, sensors and colors. Beside it lie the poses and changes as
that version held them before it saved, and the codes that its `encode` gave for one cloud with the prior `small`.
"""

import dataclasses
import json
import zipfile
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from places import DATA, ROOT

from more2_jax.geometry.padding import pad_clouds
from more2_jax.network.prior import encode, load_prior
from more2_jax.storage.scene_folder import load_scene, save_scene, scene_to_json
from more2_jax.types import LivingScene

TOLD = np.load(DATA / "living_scene_0_1_0.npz")
CODES = ("inv", "eqv", "scale", "center", "origin")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    with zipfile.ZipFile(DATA / "living_scene_0_1_0.zip") as file:
        file.extractall(at := tmp_path_factory.mktemp("old"))
    return at / "living_scene_0_1_0"


@pytest.fixture(scope="module")
def scene(folder) -> LivingScene:
    return load_scene(folder)[0]


def test_poses_are_what_they_were(scene):
    poses = {f"{o.id}/T_ref_scan/{s.scan}": s.T_ref_scan for o in scene.objects for s in o.observations}
    assert set(poses) == {k for k in TOLD.files if "/T_ref_scan/" in k}
    for name, T in poses.items():
        np.testing.assert_array_equal(T, TOLD[name], err_msg=name)
    assert not np.allclose(poses["object_001/T_ref_scan/1"], np.eye(4), atol=0.5)  # it moved


def test_changes_are_what_they_were(scene):
    then = json.loads(str(TOLD["changes"]))
    now = json.loads(json.dumps([dataclasses.asdict(c) for c in scene.changes]))
    # Which that version did not tell apart from removed and added:
    assert all(c.pop("not_seen") == c.pop("discovered") == [] for c in now)
    assert now == then
    assert (then[0]["moved"], then[0]["removed"]) == (["object_001"], ["object_002"])


def test_embeddings_are_what_was_stored(scene, folder):
    stored = np.load(folder / "embeddings.npz")
    assert [o.id for o in scene.objects] == stored["id"].tolist()
    for n, o in enumerate(scene.objects):
        for k in CODES:
            np.testing.assert_array_equal(getattr(o.embedding, k), stored[k][n])
        (anchors,) = o.embedding.anchors
        for k in ("offset", "features", "mask"):
            np.testing.assert_array_equal(getattr(anchors, k), stored[f"anchors_0_{k}"][n])


def test_the_rest_is_there(scene):
    assert [s.name for s in scene.scans] == ["monday", "friday"]
    assert [(len(s.background), len(s.sensors), len(s.skipped)) for s in scene.scans] == [(200, 2, 1)] * 2
    assert [len(o.points) for o in scene.objects] == [280, 280, 140, 140]
    assert all(o.mesh is not None and len(o.mesh.faces) > 100 for o in scene.objects)
    assert all(o.color is not None for o in scene.objects)


def test_what_is_stored_again_says_the_same(scene, folder, tmp_path):
    then = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
    assert scene_to_json(scene) == then
    jsonschema.validate(then, json.loads((ROOT / "more2_jax/assets/scene.schema.json").read_text()))
    save_scene(scene, tmp_path / "again", load_scene(folder)[1])
    assert json.loads((tmp_path / "again/scene.json").read_text(encoding="utf-8")) == then


def test_settings_are_what_they_were(folder):
    config = load_scene(folder)[1]
    assert (config.preset, config.upright, config.min_points) == ("robust", True, 32)
    assert (config.joint.steps, config.joint.points, config.meshing.resolution) == (3, 32, 8)


@pytest.mark.slow
def test_stored_weights_give_the_same_codes(tmp_path):
    """Of a file with the header of that version: `neighbours` as it spelled them, and one decoder, without normals."""
    with np.load(ROOT / "more2_jax/assets/weights/small.npz") as file:
        arrays, header = dict(file), json.loads(str(file["__header__"]))
    config = header["config"]
    config["encoder"]["neighbours"] = neighbors = config["encoder"].pop("neighbors")
    del config["decoder"]["normals"], config["bare_decoder"]
    then = {
        k.removeprefix("bare_"): v for k, v in arrays.items() if k.startswith(("encoder/", "bare_decoder/"))
    }
    np.savez(tmp_path / "then.npz", __header__=np.array(json.dumps(header)), **then)
    prior = load_prior(tmp_path / "then.npz")
    assert prior.config.encoder.neighbors == neighbors
    e = encode(prior, pad_clouds([TOLD["small/points"]]))
    for k in ("inv", "eqv", "scale", "center"):
        then = TOLD[f"small/{k}"]
        off = np.abs(np.asarray(getattr(e, k))[0] - then).max() / np.abs(then).max()
        assert off < 1e-5, (k, off)
