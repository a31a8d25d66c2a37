"""The preparation of shards: complete, resumable, reproducible; what is left out is named with its reason."""

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from more2_jax.data.meshes import SourceMesh
from more2_jax.data.shards import load_shapes
from train import prepare
from train.program import run


def broken(vertices: list, faces: list) -> SourceMesh:
    return SourceMesh(
        name="broken",
        category="x",
        vertices=np.array(vertices, float).reshape(-1, 3),
        faces=np.array(faces, np.int64).reshape(-1, 3),
        source="made",
    )


SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]


@pytest.mark.parametrize(
    ("mesh", "reason"),
    [
        (broken([], []), "0 vertices"),
        (broken(SQUARE, []), "0 faces"),
        (broken(SQUARE, [[0, 1, 9]]), "0 to 9 of 4"),
        (broken([[0, 0, 0]] * 3, [[0, 1, 2]]), "extent"),
        (broken([[0, 0, np.nan], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]), "extent"),
        (broken([[0, 0, 0], [1, 0, 0], [0.5, 0, 1e-6]], [[0, 1, 2]]), "hits"),
    ],
)
def test_degenerate_meshes_are_named_with_a_reason(mesh: SourceMesh, reason: str):
    result = prepare.prepare(mesh)
    assert result["name"] == "broken"
    assert reason in result["reason"]


def test_a_board_without_thickness_keeps_an_inside():
    strip = np.array(SQUARE) * (1, 0.7, 1)
    result = prepare.prepare(broken(strip.tolist(), [[0, 1, 2], [0, 2, 3]]))
    assert result["sdf_near"][:, 3].min() < 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of two good meshes and one that cannot be used."""
    path = tmp_path_factory.mktemp("meshes")
    trimesh.creation.box((1, 2, 3)).export(path / "box.ply")
    trimesh.creation.icosphere(2).export(path / "ball.ply")
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0.5, 0, 1e-6]], [[0, 1, 2]]).export(path / "needle.ply")
    return path


def test_shards_resume_and_repeat(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(prepare, "SHARD", 2)
    prepare.main(tmp_path, (folder,), procedural=1, workers=1)
    first, second = sorted(tmp_path.glob("shard_*.npz"))
    kept, arrays = first.stat().st_mtime_ns, dict(np.load(second))
    second.unlink()
    prepare.main(tmp_path, (folder,), procedural=1, workers=1)
    assert first.stat().st_mtime_ns == kept
    for name, array in np.load(second).items():
        np.testing.assert_array_equal(array, arrays[name])
    assert not list(tmp_path.glob("*.partial"))
    names = {str(n) for path in (first, second) for n in np.load(path)["names"]}
    assert names == {"box.ply", "ball.ply", "procedural_bench_0000"}
    rejected = json.loads((tmp_path / "report.json").read_text())["rejected"]
    assert list(rejected) == ["needle.ply"]
    assert "hits" in rejected["needle.ply"]
    with pytest.raises(ValueError, match="shards of other meshes"):
        prepare.main(tmp_path, (folder,), procedural=2, workers=1)


def test_load_shapes_splits_and_skips_a_shard_without_shapes(tmp_path: Path):
    def shape(name: str, split: str) -> dict:
        return {
            "views": np.zeros((24, 384, 3), np.float16),
            "sdf_uniform": np.zeros((8000, 4), np.float16),
            "sdf_near": np.zeros((8000, 4), np.float16),
            "names": name,
            "categories": "box",
            "sources": "made",
            "splits": split,
            "scale_m": np.float32(1),
        }

    prepare.write_shard(tmp_path / "shard_000.npz", [])
    prepare.write_shard(
        tmp_path / "shard_001.npz", [shape("a", "train"), shape("b", "val"), shape("c", "train")]
    )
    assert load_shapes(tmp_path, "train").views.shape == (2, 24, 384, 3)
    assert load_shapes(tmp_path, "val").sdf_near.shape == (1, 8000, 4)
    with pytest.raises(ValueError, match="no test shapes"):
        load_shapes(tmp_path, "test")


def test_about_a_tenth_is_kept_for_validation_whatever_the_order():
    mesh = broken(SQUARE, [[0, 1, 2]])
    digests = [dataclasses.replace(mesh, name=f"model_{k}").digest for k in range(2000)]
    share = np.mean([d % 2**16 % prepare.VALIDATION_SHARE == 0 for d in digests])
    assert 0.08 < share < 0.12


@pytest.mark.parametrize(
    ("arguments", "message"), [([], "no meshes"), (["--source", "nothing.npz"], "nothing.npz")]
)
def test_bad_input_ends_in_one_line_and_code_2(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.setattr(sys, "argv", ["prepare", "--out", str(tmp_path / "out"), *arguments])
    with pytest.raises(SystemExit) as ended:
        run(prepare.main)
    error = capsys.readouterr().err
    assert ended.value.code == 2
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()
