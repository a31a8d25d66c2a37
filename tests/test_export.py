"""Exports place every object where the scan saw it, and other readers agree."""

import dataclasses
import json
import sys

import numpy as np
import pytest
import trimesh
from factories import living_scene, scene_object
from plyfile import PlyData

from more2_jax.export import export_scene, pose_in

SCENE = living_scene()


def seen_in(o, scan):
    return next((s for s in o.observations if s.scan == scan), None)


def placed(o, points, scan):
    """The definition: `T_ref_scan` takes scan points to the reference, so its inverse brings them back."""
    T = np.linalg.inv(seen_in(o, scan).T_ref_scan)
    return (np.c_[points, np.ones(len(points))] @ T.T)[:, :3]


def test_pose_in_undoes_T_ref_scan():
    o = SCENE.objects[1]
    T_ref_scan = seen_in(o, 1).T_ref_scan
    np.testing.assert_allclose(pose_in(o, 1) @ T_ref_scan, np.eye(4), atol=1e-9)
    assert np.abs(pose_in(o, 1) - T_ref_scan).max() > 1  # its inverse, not itself
    assert pose_in(SCENE.objects[2], 1) is None


@pytest.mark.parametrize("scan", [0, 1, 2, -1])
def test_ply_places_all_points_in_the_scan(tmp_path, scan):
    path = export_scene(SCENE, tmp_path, "ply", scan=scan)
    assert path == tmp_path / "export.ply"
    vertices = PlyData.read(str(path))["vertex"]
    points = np.stack([vertices[a] for a in "xyz"], axis=-1)
    s = scan % 3
    there = [k for k, o in enumerate(SCENE.objects) if seen_in(o, s)]
    assert np.unique(vertices["object"]).tolist() == there
    for k in there:
        o = SCENE.objects[k]
        np.testing.assert_allclose(points[vertices["object"] == k], placed(o, o.points, s), atol=1e-8)


@pytest.mark.parametrize("scan", [0, 1, 2])
def test_glb_has_one_named_node_an_object_where_the_scan_saw_it(tmp_path, scan):
    path = export_scene(SCENE, tmp_path / "room.glb", "glb", scan=scan)
    graph = trimesh.load_scene(path)
    there = {o.id: o for o in SCENE.objects if seen_in(o, scan)}
    assert set(graph.graph.nodes_geometry) == set(there)
    for name, o in there.items():
        T, geometry = graph.graph[name]
        vertices = trimesh.transform_points(graph.geometry[geometry].vertices, T)
        expected = placed(o, o.points if o.mesh is None else o.mesh.vertices, scan)
        np.testing.assert_allclose(np.sort(vertices, axis=0), np.sort(expected, axis=0), atol=1e-3)


def test_an_asymmetric_shape_is_not_mirrored_in_glb(tmp_path):
    """Sorting coordinates hides a transpose; distances to single corners do not."""
    path = export_scene(SCENE, tmp_path, "glb", scan=1)
    graph = trimesh.load_scene(path)
    o = SCENE.objects[1]
    T, geometry = graph.graph[o.id]
    mesh = graph.geometry[geometry].copy().apply_transform(T)
    first = placed(o, o.mesh.vertices[:1], 1)[0]
    assert np.linalg.norm(mesh.vertices - first, axis=1).argmin() == 0
    assert mesh.volume == pytest.approx(1.0, abs=1e-3)  # a mirrored cube has volume −1


def test_json_is_poses_only(tmp_path):
    content = json.loads(export_scene(SCENE, tmp_path, "json").read_text())
    assert set(content["objects"][0]) == {"id", "label", "reference_scan", "observations"}
    np.testing.assert_array_equal(
        content["objects"][1]["observations"][1]["T_ref_scan"], SCENE.objects[1].observations[1].T_ref_scan
    )
    assert content["changes"][0]["moved"] == ["object_001"]


def test_usd_has_a_time_sample_a_scan(tmp_path):
    pytest.importorskip("pxr.Usd")
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(export_scene(SCENE, tmp_path, "usd")))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    for o in SCENE.objects:
        shape = stage.GetPrimAtPath(f"/scene/{o.id}/shape")
        local = np.array(shape.GetAttribute("points").Get(), np.float64)
        for s in range(3):
            visible = UsdGeom.Imageable(shape).ComputeVisibility(s) != "invisible"
            assert visible == (seen_in(o, s) is not None)
            if visible:
                T = np.array(UsdGeom.Xformable(shape).ComputeLocalToWorldTransform(s))  # row vectors
                world = (np.c_[local, np.ones(len(local))] @ T)[:, :3]
                expected = placed(o, o.points if o.mesh is None else o.mesh.vertices, s)
                np.testing.assert_allclose(world, expected, atol=1e-5)


def test_exporting_usd_twice_replaces_the_file(tmp_path):
    pytest.importorskip("pxr.Usd")
    first = export_scene(SCENE, tmp_path, "usd").read_bytes()
    assert export_scene(SCENE, tmp_path, "usd").read_bytes() == first


def test_without_usd_the_extra_is_named(tmp_path, monkeypatch):
    for module in ("pxr", "pxr.Gf", "pxr.Usd", "pxr.UsdGeom"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ValueError, match=r"extra usd.*more2-jax\[usd\]"):
        export_scene(SCENE, tmp_path, "usd")


@pytest.mark.parametrize(
    ("format", "scan", "message"),
    [("obj", -1, "format 'obj'; needed one of glb"), ("ply", 3, "scan 3 of 3"), ("glb", -4, "scan -4 of 3")],
)
def test_bad_requests_are_named(tmp_path, format, scan, message):
    with pytest.raises(ValueError, match=message):
        export_scene(SCENE, tmp_path, format, scan=scan)


@pytest.mark.parametrize("format", ["ply", "glb"])
def test_a_scan_without_objects_is_named(tmp_path, format):
    lonely = dataclasses.replace(SCENE, objects=(scene_object(0, {0: np.eye(4)}),))
    with pytest.raises(ValueError, match="shows no object"):
        export_scene(lonely, tmp_path, format, scan=1)


def test_a_living_scene_is_not_overwritten(tmp_path):
    (tmp_path / "scene.json").write_text("{}")
    with pytest.raises(ValueError, match="part of a living scene"):
        export_scene(SCENE, tmp_path / "scene.json", "json")
    assert export_scene(SCENE, tmp_path, "json").name == "export.json"
    assert (tmp_path / "scene.json").read_text() == "{}"
