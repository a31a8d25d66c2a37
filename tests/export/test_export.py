"""What each export holds, and what is refused."""

import dataclasses
import json
import sys

import jsonschema
import numpy as np
import pytest
import trimesh
from export_readers import Z_UP_OF_Y_UP, Gltf, placed, seen_in, usd_shown
from factories import WORLD_M, living_scene, scene_object, turn_z
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from more2_jax.export import export_scene, pose_in
from more2_jax.types import LivingScene

SCENE = living_scene()


def test_pose_in_undoes_T_ref_scan():
    o = SCENE.objects[1]
    T_ref_scan = seen_in(o, 1).T_ref_scan
    np.testing.assert_allclose(pose_in(o, 1) @ T_ref_scan, np.eye(4), atol=1e-9)
    assert np.abs(pose_in(o, 1) - T_ref_scan).max() > 1  # its inverse, not itself
    assert pose_in(SCENE.objects[2], 1) is None


# --- glTF -------------------------------------------------------------------------------------------------------


def test_glb_has_a_keyframe_a_scan_and_objects_vanish_in_steps(tmp_path):
    gltf = Gltf(export_scene(SCENE, tmp_path, "glb"))
    (animation,) = gltf.file.animations
    assert animation.name == "scans"
    for o in SCENE.objects:
        channels = gltf.sampled(gltf.nodes[o.id])
        assert {k: v[2] for k, v in channels.items()} == {
            "translation": "LINEAR",
            "rotation": "LINEAR",
            "scale": "STEP",
        }
        for times, values, _ in channels.values():
            assert times.tolist() == [0, 1, 2] and len(values) == 3
        assert channels["scale"][1][:, 0].tolist() == [seen_in(o, s) is not None for s in range(3)]
        np.testing.assert_allclose(np.linalg.norm(channels["rotation"][1], axis=1), 1, atol=1e-6)
        node = gltf.file.nodes[gltf.nodes[o.id]]
        assert node.matrix is None  # the standard forbids one on animated nodes
        states = ["absent" if seen_in(o, s) is None else "seen" for s in range(3)]
        assert node.extras == {"id": o.id, "label": o.label, "states": states}


def test_glb_turns_the_short_way_between_scans(tmp_path):
    turns = {s: np.eye(4) for s in range(3)}
    for s, angle in enumerate((170, 190, 350)):
        turns[s][:3, :3] = Rotation.from_euler("z", angle, degrees=True).as_matrix().T
    gltf = Gltf(export_scene(dataclasses.replace(SCENE, objects=(scene_object(0, turns),)), tmp_path, "glb"))
    _, values, _ = gltf.sampled(gltf.nodes["object_000"])["rotation"]
    assert ((values[1:] * values[:-1]).sum(axis=1) > 0).all()
    first, second = Rotation.from_quat(values[:2])
    assert np.rad2deg((first.inv() * second).magnitude()) == pytest.approx(20, abs=1e-3)


@pytest.mark.parametrize("scan", [0, 1, 2])
def test_glb_rests_in_the_scan_asked_for_with_y_up(tmp_path, scan):
    """trimesh reads nodes at rest, not animations; a kilometer from the world's zero."""
    graph = trimesh.load_scene(export_scene(SCENE, tmp_path / "room.glb", "glb", scan=scan))
    assert set(graph.graph.nodes_geometry) == {o.id for o in SCENE.objects}
    for o in SCENE.objects:
        T, geometry = graph.graph[o.id]
        if seen_in(o, scan) is None:
            np.testing.assert_array_equal(T[:3, :3], 0)
            continue
        y_up = trimesh.transform_points(graph.geometry[geometry].vertices, T)
        expected = placed(o, o.points if o.mesh is None else o.mesh.vertices, scan)
        np.testing.assert_allclose(y_up[:, 1], expected[:, 2], atol=1e-4)  # glTF's y is our z
        np.testing.assert_allclose(y_up @ Z_UP_OF_Y_UP.T, expected, atol=1e-4)
        if o.mesh is not None:
            mesh = graph.geometry[geometry].copy().apply_transform(T)
            assert mesh.volume == pytest.approx(1.0, abs=1e-3)  # a mirrored cube has volume −1


def test_glb_of_one_scan(tmp_path):
    one = dataclasses.replace(
        SCENE, scans=SCENE.scans[:1], objects=(scene_object(0, {0: np.eye(4)}),), changes=()
    )
    vertices, _ = Gltf(export_scene(one, tmp_path, "glb")).shown("object_000", 0)
    np.testing.assert_allclose(vertices, one.objects[0].mesh.vertices, atol=1e-4)


# --- the others -------------------------------------------------------------------------------------------------


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


def test_an_object_keeps_its_number_where_others_are_gone(tmp_path):
    """Joined parts leave gaps among the ids."""
    fewer = dataclasses.replace(SCENE, objects=SCENE.objects[1:], changes=())
    vertices = PlyData.read(str(export_scene(fewer, tmp_path, "ply", scan=0)))["vertex"]
    ids = [o.id for o in fewer.objects if seen_in(o, 0)]
    assert [f"object_{n:03d}" for n in np.unique(vertices["object"])] == ids


POSE = {
    "type": "array",
    "items": {"type": "array", "items": {"type": "number"}, "minItems": 4, "maxItems": 4},
}
IDS = {"type": "array", "items": {"type": "string", "pattern": "^object_[0-9]{3,}$"}}
INDEX = {"type": "integer", "minimum": 0}


def exactly(**properties) -> dict:
    return {
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }


SCHEMA = exactly(
    version={"const": 1},
    unit={"const": "m"},
    up_axis={"const": "z"},
    preset={"type": "string"},
    prior={"type": "string"},
    upright={"type": "boolean"},
    scans={"type": "array"},
    timing_s={"type": "object", "additionalProperties": {"type": "number", "minimum": 0}},
    objects={
        "type": "array",
        "items": exactly(
            id={"type": "string"},
            label={"type": ["string", "null"]},
            reference_scan=INDEX,
            observations={
                "type": "array",
                "minItems": 1,
                "items": exactly(
                    scan=INDEX,
                    instance={"type": "integer", "minimum": 1},
                    T_ref_scan=POSE | {"minItems": 4, "maxItems": 4},
                    score={"type": "number"},
                    rms_m={"type": "number", "minimum": 0},
                    converged={"type": "boolean"},
                    interchangeable={"type": "boolean"},
                    sigma_m={"type": "number", "minimum": 0},
                    sigma_deg={"type": "number", "minimum": 0},
                    misfit={"type": "number", "minimum": 0, "maximum": 1},
                    accumulated={"type": "boolean"},
                ),
            },
        ),
    },
    changes={
        "type": "array",
        "items": exactly(
            **{"from": INDEX, "to": INDEX},
            moved=IDS,
            static=IDS,
            added=IDS,
            removed=IDS,
            probability={
                "type": "object",
                "propertyNames": {"pattern": "^object_[0-9]{3,}$"},
                "additionalProperties": {"type": "number", "minimum": 0, "maximum": 1},
            },
        ),
    },
)


def test_json_is_poses_and_changes_by_its_schema(tmp_path):
    content = json.loads(export_scene(SCENE, tmp_path, "json").read_text())
    jsonschema.validate(content, SCHEMA)
    np.testing.assert_array_equal(
        content["objects"][1]["observations"][1]["T_ref_scan"], SCENE.objects[1].observations[1].T_ref_scan
    )
    assert content["changes"][0]["moved"] == ["object_001"]


def test_usd_says_unit_axis_times_and_extent(tmp_path):
    pytest.importorskip("pxr.Usd")
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(export_scene(SCENE, tmp_path, "usd")))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 2)
    assert stage.GetDefaultPrim().GetPath() == "/scene"
    for o in SCENE.objects:
        node = stage.GetPrimAtPath(f"/scene/{o.id}")
        assert node.GetAttribute("visibility").GetTimeSamples() == [0, 1, 2]
        assert node.GetAttribute("xformOp:orient").GetTimeSamples() == [0, 1, 2]
        assert node.GetCustomDataByKey("label") == o.label


def test_usd_stays_rigid_between_scans(tmp_path):
    pytest.importorskip("pxr.Usd")
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(export_scene(SCENE, tmp_path, "usd")))
    T = UsdGeom.Xformable(stage.GetPrimAtPath("/scene/object_001")).ComputeLocalToWorldTransform(0.5)
    R = np.array(T)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.rad2deg(Rotation.from_matrix(R).magnitude()) == pytest.approx(45)  # half of the turn by 90°


def test_exporting_usd_twice_replaces_the_file(tmp_path):
    pytest.importorskip("pxr.Usd")
    first = export_scene(SCENE, tmp_path, "usd").read_bytes()
    assert export_scene(SCENE, tmp_path, "usd").read_bytes() == first


# --- what a scan did not look at --------------------------------------------------------------------------------


def unseen_scene() -> LivingScene:
    """On tuesday objects 2 and 4 are missing; tuesday did not look where 2 stood. On friday it is elsewhere."""
    moved = turn_z(np.deg2rad(30), WORLD_M + [6.0, 0, 0], np.array([0.0, 5.0, 0.0]))
    monday, tuesday, friday = SCENE.scans
    scans = (monday, dataclasses.replace(tuesday, not_seen=("object_002",)), friday)
    again = scene_object(2, {0: np.eye(4), 2: moved})
    first = dataclasses.replace(SCENE.changes[0], removed=("object_004",), not_seen=("object_002",))
    objects = (*SCENE.objects[:2], again, *SCENE.objects[3:])
    return dataclasses.replace(SCENE, scans=scans, objects=objects, changes=(first, SCENE.changes[1]))


UNSEEN = unseen_scene()
STATES = {
    "object_000": ["seen", "seen", "seen"],
    "object_002": ["seen", "not_seen", "seen"],
    "object_003": ["absent", "seen", "seen"],
    "object_004": ["seen", "absent", "seen"],
}


def test_glb_shows_what_is_not_seen_pale_where_it_stood_and_what_is_removed_not_at_all(tmp_path):
    gltf = Gltf(export_scene(UNSEEN, tmp_path, "glb", scan=1))
    assert set(gltf.nodes) >= {o.id for o in UNSEEN.objects} | {"object_002_not_seen"}
    assert [n for n in gltf.nodes if n and n.endswith("_not_seen")] == ["object_002_not_seen"]
    for name, states in STATES.items():
        assert gltf.file.nodes[gltf.nodes[name]].extras["states"] == states
    assert gltf.shown("object_002", 1) is None and gltf.shown("object_004", 1) is None
    shown = [gltf.shown("object_002_not_seen", s) for s in range(3)]
    assert shown[0] is None and shown[2] is None
    np.testing.assert_allclose(shown[1][0], gltf.shown("object_002", 0)[0], atol=1e-4)
    rest = gltf.file.nodes[gltf.nodes["object_002_not_seen"]]
    assert rest.scale == [1, 1, 1]  # at rest in that scan
    pale = gltf.file.materials[gltf.file.meshes[rest.mesh].primitives[0].material]
    assert pale.alphaMode == "BLEND" and 0.1 < pale.pbrMetallicRoughness.baseColorFactor[3] < 0.4
    (_, where, _) = gltf.sampled(gltf.nodes["object_002_not_seen"])["translation"]
    np.testing.assert_array_equal(
        where[1], where[2]
    )  # it vanishes, and does not glide to where the object is


def test_usd_shows_what_is_not_seen_pale_where_it_stood_and_says_so(tmp_path):
    pytest.importorskip("pxr.Usd")
    from pxr import Usd, UsdGeom

    path = export_scene(UNSEEN, tmp_path, "usd")
    stage = Usd.Stage.Open(str(path))
    for name, states in STATES.items():
        told = stage.GetPrimAtPath(f"/scene/{name}").GetAttribute("more2:state")
        assert [told.Get(s) for s in range(3)] == states
    assert usd_shown(path, "object_002", 1) is None and usd_shown(path, "object_004", 1) is None
    pale = [usd_shown(path, "object_002_not_seen", s) for s in range(3)]
    assert pale[0] is None and pale[2] is None
    before = usd_shown(path, "object_002", 0)
    for a, b in zip(pale[1], before, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)
    shape = UsdGeom.Gprim(stage.GetPrimAtPath("/scene/object_002_not_seen/shape"))
    assert 0.1 < shape.GetDisplayOpacityAttr().Get()[0] < 0.4
    assert not stage.GetPrimAtPath("/scene/object_004_not_seen")


def test_ply_names_what_the_scan_did_not_look_at(tmp_path):
    comments = [PlyData.read(str(export_scene(UNSEEN, tmp_path, "ply", scan=s))).comments for s in range(3)]
    assert comments == [[], ["not seen: object 2"], []]


def test_json_tells_what_was_not_seen_from_what_was_removed(tmp_path):
    content = json.loads(export_scene(UNSEEN, tmp_path, "json").read_text())
    assert [s.get("not_seen", []) for s in content["scans"]] == [[], ["object_002"], []]
    (change, _) = content["changes"]
    assert (change["not_seen"], change["removed"]) == (["object_002"], ["object_004"])


# --- what is refused --------------------------------------------------------------------------------------------


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


def test_usd_needs_a_suffix_it_knows(tmp_path):
    with pytest.raises(ValueError, match=r"suffix '.txt'; needed one of .usda"):
        export_scene(SCENE, tmp_path / "room.txt", "usd")
    pytest.importorskip("pxr.Usd")
    assert export_scene(SCENE, tmp_path / "room.usdc", "usd").read_bytes().startswith(b"PXR-USDC")


@pytest.mark.parametrize("format", ["ply", "glb"])
def test_a_scan_without_objects_is_named(tmp_path, format):
    lonely: LivingScene = dataclasses.replace(SCENE, objects=(scene_object(0, {0: np.eye(4)}),))
    with pytest.raises(ValueError, match="shows no object"):
        export_scene(lonely, tmp_path, format, scan=1)


def test_a_living_scene_is_not_overwritten(tmp_path):
    (tmp_path / "scene.json").write_text("{}")
    with pytest.raises(ValueError, match="part of a living scene"):
        export_scene(SCENE, tmp_path / "scene.json", "json")
    assert export_scene(SCENE, tmp_path, "json").name == "export.json"
    assert (tmp_path / "scene.json").read_text() == "{}"
