"""Exports as readers other than the exporters show them."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from more2_jax.types import SceneObject

Z_UP_OF_Y_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # glTF's (x, up, −y) back to (x, y, up)


def seen_in(o, scan):
    return next((s for s in o.observations if s.scan == scan), None)


def placed(o, points, scan):
    """The definition: `T_ref_scan` takes scan points to the reference, so its inverse brings them back."""
    T = np.linalg.inv(seen_in(o, scan).T_ref_scan)
    return (np.c_[points, np.ones(len(points))] @ T.T)[:, :3]


# --- an object in a scan: vertices and faces, None where absent -------------------------------------------------


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
