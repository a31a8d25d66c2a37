"""Mesh collections: what is packed comes back, what is damaged is refused; unseen furniture is in meters."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import trimesh
from places import DATA

from train.furniture.collections import SourceMesh, check_mesh, read_meshes, standing, write_packed
from train.furniture.heldout import IKEA_LONGEST_M, read_ikea
from train.furniture.mesh_files import read_mesh_file
from train.furniture.shapenet import SYNSETS

UNSEEN = DATA / "unseen_furniture.npz"


def mesh(name: str, extents: tuple[float, float, float], category: str = "box") -> SourceMesh:
    box = trimesh.creation.box(extents)
    return SourceMesh(
        name=name,
        category=category,
        vertices=np.asarray(box.vertices) + 5.0,
        faces=np.asarray(box.faces),
        source="made",
    )


def test_packed_meshes_come_back(tmp_path: Path):
    given = [mesh("a", (1, 2, 3)), mesh("b", (0.5, 0.5, 0), "plate")]  # the second has no height
    write_packed(tmp_path / "two.npz", given)
    found = list(read_meshes(tmp_path / "two.npz"))
    assert [(m.name, m.category) for m in found] == [("a", "box"), ("b", "plate")]
    for one, other in zip(given, found, strict=True):
        np.testing.assert_allclose(other.vertices, one.vertices, atol=3 / 65535)
        np.testing.assert_array_equal(other.faces, one.faces)


def test_a_collection_without_categories_is_named_after_its_file(tmp_path: Path):
    write_packed(tmp_path / "all.npz", [mesh("a", (1, 2, 3))])
    with np.load(tmp_path / "all.npz") as packed:
        arrays = {k: packed[k] for k in packed.files if k != "categories"}
    np.savez(tmp_path / "infinigen_Stool.npz", **arrays)
    assert [m.category for m in read_meshes(tmp_path / "infinigen_Stool.npz")] == ["Stool"]


def test_trash_cans_get_a_size_and_nothing_else_does(tmp_path: Path):
    wide = [mesh("TrashFactory_0001", (1.2, 1.2, 1.5)), mesh("ChairFactory_0001", (1.2, 1.2, 1.5))]
    write_packed(tmp_path / "infinigen_two.npz", wide)
    can, chair = (np.ptp(m.vertices, axis=0) for m in read_meshes(tmp_path / "infinigen_two.npz"))
    assert 0.25 <= can[2] <= 0.7
    np.testing.assert_allclose(can / can[2], [0.8, 0.8, 1], atol=1e-3)
    np.testing.assert_allclose(chair, [1.2, 1.2, 1.5], atol=1e-3)


def test_a_folder_of_meshes(tmp_path: Path):
    (tmp_path / "chair").mkdir()
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "chair" / "one.obj")
    trimesh.creation.icosphere(1).export(tmp_path / "two.ply")
    (tmp_path / "notes.txt").write_text("not a mesh")
    found = {m.name: m for m in read_meshes(tmp_path)}
    assert {k: m.category for k, m in found.items()} == {"chair/one.obj": "chair", "two.ply": "object"}
    np.testing.assert_allclose(np.ptp(found["chair/one.obj"].vertices, axis=0), (1, 2, 3))


def test_a_table_names_category_split_and_license(tmp_path: Path):
    (tmp_path / "meshes").mkdir()
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "meshes" / "one.off")
    trimesh.creation.icosphere(1).export(tmp_path / "meshes" / "two.stl")
    table = tmp_path / "list.csv"
    table.write_text("path,category,split,license\nmeshes/one.off,chair,test,CC0\nmeshes/two.stl,,,\n")
    one, two = read_meshes(table)
    assert (one.category, one.split, one.license, one.chosen_split) == ("chair", "test", "CC0", "test")
    assert (two.category, two.split, two.license) == ("object", None, "unknown")
    table.write_text("path,split\nmeshes/one.off,tomorrow\n")
    with pytest.raises(ValueError, match="split 'tomorrow'; needed train, val, test"):
        list(read_meshes(table))
    table.write_text("file\nmeshes/one.off\n")
    with pytest.raises(ValueError, match="columns file; needed path"):
        list(read_meshes(table))


def test_unreadable_files_go_to_the_report_and_the_rest_is_read(tmp_path: Path):
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "good.ply")
    for suffix in (".obj", ".off", ".stl", ".glb", ".ply"):
        (tmp_path / f"torn{suffix}").write_bytes(b"\x00\xffnot a mesh")
    told: dict[str, str] = {}
    found = list(read_meshes(tmp_path, report=told.__setitem__))
    assert "good.ply" in [m.name for m in found]
    assert {f"torn{s}" for s in (".off", ".glb", ".ply")} <= set(told)
    assert all("\n" not in reason for reason in told.values())
    with pytest.raises(ValueError, match="not a readable mesh"):
        read_mesh_file(tmp_path / "torn.glb", "x", "x", "x")


def test_shapenet_layout_with_its_table_of_splits(tmp_path: Path):
    synset = next(s for s, name in SYNSETS.items() if name == "chair")
    for model in ("a1", "b2", "c3"):
        (tmp_path / synset / model / "models").mkdir(parents=True)
    for model in ("a1", "b2"):
        trimesh.creation.box((1, 2, 3)).export(tmp_path / synset / model / "models" / "model_normalized.obj")
    (tmp_path / "all.csv").write_text(
        f"id,synsetId,subSynsetId,modelId,split\n1,{synset.lstrip('0')},x,a1,test\n"
    )
    told: dict[str, str] = {}
    first, second = read_meshes(tmp_path, report=told.__setitem__)
    assert (first.name, first.category, first.split) == (f"{synset}/a1", "chair", "test")
    assert second.split is None
    assert "ShapeNet" in second.license
    assert list(told) == [f"{synset}/c3"]
    assert "model_normalized.obj" in told[f"{synset}/c3"]


def test_the_content_hash_depends_on_the_geometry_alone():
    one = mesh("a", (1, 2, 3))
    assert one.content_hash == dataclasses.replace(one, name="b", category="x").content_hash
    assert one.content_hash != mesh("a", (1, 2, 3.01)).content_hash


def test_damaged_sources_are_refused_in_one_line(tmp_path: Path):
    (tmp_path / "torn.npz").write_bytes(UNSEEN.read_bytes()[:5000])
    np.savez(tmp_path / "other.npz", vertices=np.zeros((1, 3)))
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "torn.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\n")
    cases = {
        "torn.npz": "not a readable",
        "other.npz": "lack faces, hi, lo",
        "folder": "torn.ply",
        "none": "needed a",
    }
    for name, message in cases.items():
        with pytest.raises(ValueError, match=message) as caught:
            list(read_meshes(tmp_path / name))
        assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="no meshes"):
        write_packed(tmp_path / "empty.npz", [])


def test_the_digest_depends_on_the_name_alone():
    one = mesh("a", (1, 2, 3))
    assert one.digest == dataclasses.replace(one, vertices=one.vertices * 2, category="x").digest
    assert one.digest != dataclasses.replace(one, name="b").digest
    assert one.digest % 2**32 == 0x377667B8  # the same on every machine: splits depend on it


@pytest.mark.parametrize(
    ("faces", "message"), [([], "0 faces"), ([[0, 1, 8]], "0 to 8 of 8"), ([[-1, 0, 1]], "-1 to 1")]
)
def test_check_mesh(faces: list, message: str):
    good = mesh("a", (1, 2, 3))
    check_mesh(good)
    with pytest.raises(ValueError, match=message):
        check_mesh(dataclasses.replace(good, faces=np.array(faces, np.int64).reshape(-1, 3)))


def test_standing():
    vertices = standing(mesh("a", (1, 2, 3)).vertices)
    np.testing.assert_allclose([vertices.min(axis=0), vertices.max(axis=0)], [[-0.5, -1, 0], [0.5, 1, 3]])


def test_unseen_furniture_is_metric_and_every_piece_is_attributed():
    found = list(read_meshes(UNSEEN))
    assert len(found) >= 12
    assert len({m.name for m in found}) == len(found)
    assert UNSEEN.stat().st_size <= 600_000
    licenses = UNSEEN.with_suffix(".LICENSES.md").read_text()
    for m in found:
        check_mesh(m)
        np.testing.assert_allclose(standing(m.vertices), m.vertices, atol=1e-4)
        assert 0.2 < np.ptp(m.vertices, axis=0).max() < 2.5, m.name
        assert f"catalog number {int(m.name[-3:])})" in licenses


def test_ikea_gets_a_size_and_stands_up(tmp_path: Path):
    tall = dataclasses.replace(mesh("Chair_tall", (1, 4, 1)), source="ikea")  # y up in the collection
    write_packed(tmp_path / "ikea.npz", [tall])
    (chair,) = read_ikea(tmp_path / "ikea.npz")
    longest = IKEA_LONGEST_M["Chair"]
    np.testing.assert_allclose(np.ptp(chair.vertices, axis=0), [longest / 4, longest / 4, longest], atol=1e-4)
    assert chair.category == "chair"
    assert abs(chair.vertices[:, 2].min()) < 1e-9
    write_packed(tmp_path / "ikea.npz", [dataclasses.replace(tall, name="Boat_x")])
    with pytest.raises(ValueError, match="category 'Boat'"):
        list(read_ikea(tmp_path / "ikea.npz"))
