"""Exports place every object where the scans saw it, and other readers agree."""

import dataclasses
import json
import sys
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import trimesh
from factories import living_scene, scene_object
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from more2_jax.export import export_scene, pose_in
from more2_jax.types import LivingScene, Mesh, Observation, SceneObject

SCENE = living_scene()
Z_UP_OF_Y_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # glTF's (x, up, −y) back to (x, y, up)


def seen_in(o, scan):
    return next((s for s in o.observations if s.scan == scan), None)


def placed(o, points, scan):
    """The definition: `T_ref_scan` takes scan points to the reference, so its inverse brings them back."""
    T = np.linalg.inv(seen_in(o, scan).T_ref_scan)
    return (np.c_[points, np.ones(len(points))] @ T.T)[:, :3]


def rigid(seed: int) -> np.ndarray:
    """A turn about all axes and a shift of metres, 50 m from zero."""
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = 50 + np.random.default_rng(seed).uniform(-3, 3, 3)
    return T


def simulated(number: int, scans: tuple[int, ...], *, mesh: bool = True) -> tuple[SceneObject, dict]:
    """A chair-like shape put down anywhere in every scan; the object, and the points each scan observed.

    Nothing here uses T_ref_scan except to store it: the observed points come from where the shape was put.
    """
    parts = [
        trimesh.creation.box((0.6, 0.5, 0.1)),
        trimesh.creation.box((0.1, 0.5, 0.9)).apply_translation([0.25, 0, 0.5]),
    ]
    shape = trimesh.util.concatenate(parts)
    T_scan_shape = {s: rigid(10 * number + s) for s in scans}
    observed = {
        s: trimesh.transform_points(trimesh.sample.sample_surface(shape, 200, seed=s)[0], T)
        for s, T in T_scan_shape.items()
    }
    T_ref_shape = T_scan_shape[scans[0]]
    T_ref_scan = {s: T_ref_shape @ np.linalg.inv(T) for s, T in T_scan_shape.items()}
    points = [trimesh.transform_points(observed[s], T_ref_scan[s]) for s in scans]
    seen = tuple(
        Observation(scan=s, instance=1, T_ref_scan=T_ref_scan[s], score=1.0, rms_m=0.0, converged=True)
        for s in scans
    )
    o = dataclasses.replace(
        scene_object(number, {scans[0]: np.eye(4)}),
        observations=seen,
        points=np.concatenate(points),
        point_scan=np.repeat(scans, 200),
        mesh=Mesh(vertices=trimesh.transform_points(shape.vertices, T_ref_shape), faces=shape.faces),
    )
    return (o if mesh else dataclasses.replace(o, mesh=None)), observed


OBJECTS = [
    simulated(0, (0, 1, 2)),
    simulated(1, (1, 2)),
    simulated(2, (0, 2)),
    simulated(3, (0, 1), mesh=False),
]
ROOM = dataclasses.replace(SCENE, objects=tuple(o for o, _ in OBJECTS), changes=())
OBSERVED = {o.id: observed for o, observed in OBJECTS}
LARGEST_M = 1e-4  # files hold single precision, a few metres about the nodes


def off_surface(vertices, faces, points) -> float:
    """Largest distance of points from a mesh, metres; from the vertices where there are no faces."""
    if faces is None:
        return np.linalg.norm(points[:, None] - vertices[None], axis=-1).min(axis=1).max()
    return np.abs(trimesh.proximity.signed_distance(trimesh.Trimesh(vertices, faces), points)).max()


# --- what every format shows of an object in a scan: vertices and faces, None where absent ---------------------


class Gltf:
    """The animation, evaluated by hand as the standard says, on what pygltflib reads."""

    def __init__(self, path: Path):
        pygltflib = pytest.importorskip("pygltflib")
        self.file = pygltflib.GLTF2().load(str(path))
        self.nodes = {n.name: i for i, n in enumerate(self.file.nodes)}

    def array(self, index: int) -> np.ndarray:
        a = self.file.accessors[index]
        view = self.file.bufferViews[a.bufferView]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[a.type]
        dtype = {5126: "<f4", 5125: "<u4"}[a.componentType]
        start = (view.byteOffset or 0) + (a.byteOffset or 0)
        return np.frombuffer(self.file.binary_blob(), dtype, a.count * width, start).reshape(a.count, width)

    def sampled(self, node: int) -> dict[str, tuple[np.ndarray, np.ndarray, str]]:
        (animation,) = self.file.animations
        chosen = [c for c in animation.channels if c.target.node == node]
        samplers = {c.target.path: animation.samplers[c.sampler] for c in chosen}
        return {
            k: (self.array(s.input)[:, 0], self.array(s.output), s.interpolation) for k, s in samplers.items()
        }

    def at(self, name: str, scan: int) -> dict[str, np.ndarray]:
        """Translation, rotation, scale at a keyframe; STEP and LINEAR agree there."""
        found = self.sampled(self.nodes[name])
        return {path: values[times.tolist().index(scan)] for path, (times, values, _) in found.items()}

    def shown(self, name: str, scan: int):
        keys = self.at(name, scan)
        if not keys["scale"].any():
            return None
        primitive = self.file.meshes[self.file.nodes[self.nodes[name]].mesh].primitives[0]
        local = self.array(primitive.attributes.POSITION).astype(float)
        moved = Rotation.from_quat(keys["rotation"]).apply(local) + keys["translation"]
        root = np.array(self.file.nodes[self.nodes["living_scene"]].matrix).reshape(4, 4).T  # by columns
        y_up = moved @ root[:3, :3].T + root[:3, 3]
        faces = None if primitive.indices is None else self.array(primitive.indices).reshape(-1, 3)
        return y_up @ Z_UP_OF_Y_UP.T, faces


def usd_shown(path: Path, name: str, scan: int):
    pytest.importorskip("pxr.Usd")
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))  # a prim does not keep its stage alive
    shape = stage.GetPrimAtPath(f"/scene/{name}/shape")
    if UsdGeom.Imageable(shape).ComputeVisibility(scan) == "invisible":
        return None
    T = np.array(UsdGeom.Xformable(shape).ComputeLocalToWorldTransform(scan))  # row vectors
    local = np.array(shape.GetAttribute("points").Get(), np.float64)
    faces = shape.GetAttribute("faceVertexIndices").Get() if shape.IsA(UsdGeom.Mesh) else None
    return (np.c_[local, np.ones(len(local))] @ T)[:, :3], None if faces is None else np.reshape(
        faces, (-1, 3)
    )


def ply_shown(path: Path, number: int):
    vertices = PlyData.read(str(path))["vertex"]
    mine = np.asarray(vertices["object"]) == number
    return (np.stack([vertices[a] for a in "xyz"], axis=-1)[mine], None) if mine.any() else None


def json_shown(path: Path, o: SceneObject, scan: int):
    """The file has poses only: the mesh in its reference frame is moved by the pose as documented."""
    (stored,) = (e for e in json.loads(path.read_text())["objects"] if e["id"] == o.id)
    poses = {seen["scan"]: np.linalg.inv(seen["T_ref_scan"]) for seen in stored["observations"]}
    if scan not in poses:
        return None
    vertices, faces = (o.points, None) if o.mesh is None else (o.mesh.vertices, o.mesh.faces)
    return trimesh.transform_points(vertices, poses[scan]), faces


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported")
    paths = {f: export_scene(ROOM, folder, f) for f in ("glb", "usd", "json")}
    return paths | {("ply", s): export_scene(ROOM, folder / f"room{s}.ply", "ply", scan=s) for s in range(3)}


@pytest.mark.parametrize("scan", [0, 1, 2])
@pytest.mark.parametrize("format", ["glb", "usd", "ply", "json"])
def test_every_format_puts_objects_on_the_points_the_scan_observed(exported, format, scan):
    """`T_ref_scan` means the same everywhere: its inverse brings the reference onto the scan; absent is absent."""
    for k, o in enumerate(ROOM.objects):
        shown = {
            "glb": lambda o=o: Gltf(exported["glb"]).shown(o.id, scan),
            "usd": lambda o=o: usd_shown(exported["usd"], o.id, scan),
            "ply": lambda k=k: ply_shown(exported["ply", scan], k),
            "json": lambda o=o: json_shown(exported["json"], o, scan),
        }[format]()
        assert (shown is not None) == (scan in OBSERVED[o.id])
        if shown is not None:
            assert off_surface(*shown, OBSERVED[o.id][scan]) < LARGEST_M
            others = [p for s, p in OBSERVED[o.id].items() if s != scan]
            assert all(off_surface(*shown, p) > 0.1 for p in others)  # another scan's place is another place


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
        assert node.extras == {"id": o.id, "label": o.label}


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
    """trimesh reads nodes at rest, not animations; a kilometre from the world's zero."""
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
                ),
            },
        ),
    },
    changes={
        "type": "array",
        "items": exactly(**{"from": INDEX, "to": INDEX}, moved=IDS, static=IDS, added=IDS, removed=IDS),
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
