"""The preparation of shards: complete, resumable, reproducible; what is left out is named with its reason."""

import dataclasses
import filecmp
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from train import prepare
from train.furniture.collections import SourceMesh
from train.furniture.procedural import procedural_mesh
from train.furniture.source_mesh import VALIDATION_SHARE
from train.run.program import run
from train.run.shape_mix import load_mix
from train.shards.shapes import make_shape
from train.shards.shards import open_shards, read_meta, read_solids, write_shard
from train.tools import census


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
        (broken([[0, 0, np.nan], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]), "not finite"),
        (broken([[0, 0, 0], [1, 0, 0], [0.5, 0, 1e-6]], [[0, 1, 2]]), "flat"),
        (broken([[0, 0, 0], [1, 0, 0], [0.5, 1, np.inf]], [[0, 1, 2]]), "not finite"),
    ],
)
def test_degenerate_meshes_are_named_with_a_reason(mesh: SourceMesh, reason: str):
    result = prepare.prepare(mesh)
    assert isinstance(result, prepare.Rejected)
    assert result.name == "broken"
    assert reason in result.reason


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of two good meshes and one that cannot be used."""
    path = tmp_path_factory.mktemp("meshes")
    trimesh.creation.box((1, 2, 3)).export(path / "box.ply")
    trimesh.creation.icosphere(2).export(path / "ball.ply")
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0.5, 0, 1e-6]], [[0, 1, 2]]).export(path / "needle.ply")
    return path


def same_files(one: Path, other: Path) -> bool:
    names = sorted(p.name for p in one.iterdir())
    return names == sorted(p.name for p in other.iterdir()) and all(
        filecmp.cmp(one / n, other / n, shallow=False) for n in names
    )


@pytest.mark.slow
def test_shards_resume_and_repeat(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(prepare, "SHARD", 2)
    out = tmp_path / "out"
    prepare.main(out, (folder,), procedural=1, workers=1)
    first, second = sorted(out.glob("shard_*"))
    kept = (first / "views.npy").stat().st_mtime_ns
    second.rename(tmp_path / "second")
    prepare.main(out, (folder,), procedural=1, workers=1)
    assert (first / "views.npy").stat().st_mtime_ns == kept
    assert same_files(second, tmp_path / "second")
    assert not list(out.glob("*.partial"))
    names = {m["name"] for path in (first, second) for m in read_meta(path)}
    assert names == {"box.ply", "ball.ply", procedural_name()}
    rejected = json.loads((out / "report.json").read_text())["rejected"]
    assert list(rejected) == ["needle.ply"]
    assert "flat" in rejected["needle.ply"]
    with pytest.raises(ValueError, match="shards of other meshes"):
        prepare.main(out, (folder,), procedural=2, workers=1)


def procedural_name() -> str:
    return next(iter(prepare.procedural_recipes(1))).name


@pytest.mark.slow
def test_a_cluster_makes_the_same_bytes(folder: Path, tmp_path: Path):
    """Two nodes of a Ray cluster on this machine against one process."""
    pytest.importorskip("ray", reason="the cluster extra is not installed")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    cluster.add_node(num_cpus=1)
    try:
        prepare.main(tmp_path / "ray", (folder,), procedural=3, ray=cluster.address)
    finally:
        cluster.shutdown()
    prepare.main(tmp_path / "alone", (folder,), procedural=3, workers=1)
    assert same_files(tmp_path / "ray" / "shard_000", tmp_path / "alone" / "shard_000")


def test_ray_is_asked_for_and_missing(tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match=r"more2-jax\[cluster\]"):
        prepare.main(tmp_path, (folder,), ray="local")


def piece(name: str, seed: int, split: str) -> SourceMesh:
    made = procedural_mesh("stool", seed)
    return dataclasses.replace(made, name=name, split=split)


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three shards, one of them empty; `b` in validation is the same stool as `a`, which is trained on."""
    path = tmp_path_factory.mktemp("shards")
    write_shard(path / "shard_000", [])
    shapes = [piece("a", 0, "train"), piece("b", 0, "val"), piece("c", 1, "train"), piece("t", 2, "test")]
    made = [make_shape(s, 300) for s in shapes]
    write_shard(path / "shard_001", made[:3])
    write_shard(path / "shard_002", made[3:])
    (path / "report.json").write_text(
        json.dumps({"rejected": {"x": "flat: 0.001 thick", "y": "flat: 0 thick"}})
    )
    return path


def test_shards_open_by_split_mapped_or_in_memory(shards: Path):
    view = open_shards(shards, "train")
    assert [m["name"] for m in view.meta] == ["a", "c"]
    assert len(view) == 2
    loaded, rows = load_mix([shards], "train")
    assert loaded.views.shape == (2, 24, 512, 3)
    assert loaded.sdf_near.shape == (2, 300, 4)
    np.testing.assert_array_equal(loaded.sdf_uniform[1], view[1]["sdf_uniform"])
    np.testing.assert_array_equal(rows, [0, 1])
    assert len(open_shards([shards, shards], "train")) == 4
    with pytest.raises(ValueError, match="no holiday shapes"):
        open_shards(shards, "holiday")
    with pytest.raises(ValueError, match="no shards"):
        open_shards(shards / "shard_001", "train")


def test_solids_come_back_closed_and_canonical(shards: Path):
    solids = read_solids(shards / "shard_001")
    assert [s.name for s in solids] == ["a", "b", "c"]
    for solid in solids:
        assert trimesh.Trimesh(solid.vertices, solid.faces, process=False).is_watertight
        np.testing.assert_allclose(np.ptp(solid.vertices, axis=0).max(), 0.9, atol=1e-4)
    assert read_solids(shards / "shard_000") == []


def test_the_census_counts_checks_and_leaves_twins_out(shards: Path, tmp_path: Path):
    census.main((shards,), tmp_path / "census.md")
    text = (tmp_path / "census.md").read_text()
    assert "Closed solids: 4 of 4" in text
    assert "| flat | 2 |" in text
    assert "| val shape nearly the same as a train shape (below 0.004) | 1 |" in text
    assert [m["name"] for m in open_shards(shards, "train").meta] == ["a", "c"]
    with pytest.raises(ValueError, match="no val shapes"):
        open_shards(shards, "val")
    (shards / "excluded.json").unlink()


def test_about_a_tenth_is_kept_for_validation_whatever_the_order():
    mesh = broken(SQUARE, [[0, 1, 2]])
    digests = [dataclasses.replace(mesh, name=f"model_{k}").digest for k in range(2000)]
    share = np.mean([d % 2**16 % VALIDATION_SHARE == 0 for d in digests])
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
