"""A living scene for other tools: glTF, USD, PLY, JSON."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import trimesh
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from more2_jax.io import WRITTEN, scene_to_json
from more2_jax.meshfile import write_points
from more2_jax.objects import apply_pose, observation_in
from more2_jax.report import rgb
from more2_jax.types import LivingScene, SceneObject

SUFFIXES = {"glb": ".glb", "usd": ".usda", "ply": ".ply", "json": ".json"}


def export_scene(scene: LivingScene, target: str | Path, format: str, *, scan: int = -1) -> Path:
    """Writes the scene as one file and returns its path.

    `target` is a file, or a folder, in which the file is called `export` and the format's suffix. Lengths are
    metres, in the frame of the scan shown. `scan` counts from 0, or from the last with −1.

    - glb: the meshes (points of objects without one) as they lie in `scan`, one named node an object.
    - ply: the accumulated points as they lie in `scan`; the vertex property `object` is the object's number.
    - json: poses and changes only, as in the living-scene folder's scene.json.
    - usd: all scans as time samples, 0 the first; needs the extra `usd`.

    Raises ValueError for an unknown format or scan, a scan without objects, USD without its extra, or a path
    that would overwrite part of a living scene.
    """
    if format not in WRITERS:
        raise ValueError(f"format {format!r}; needed one of {', '.join(WRITERS)}")
    if not -len(scene.scans) <= scan < len(scene.scans):
        raise ValueError(
            f"scan {scan} of {len(scene.scans)}; needed 0 to {len(scene.scans) - 1}, or −1 for the last"
        )
    target = Path(target)
    path = target / f"export{SUFFIXES[format]}" if target.is_dir() else target
    if path.name in WRITTEN and (path.parent / "scene.json").exists():
        raise ValueError(f"{path}: part of a living scene; needed another file")
    path.parent.mkdir(parents=True, exist_ok=True)
    WRITERS[format](scene, path, scan % len(scene.scans))
    return path


def pose_in(o: SceneObject, scan: int) -> np.ndarray | None:
    """T_scan_ref, 4×4: takes an object's mesh and points to where they lie in a scan; None if absent."""
    seen = observation_in(o, scan)
    return None if seen is None else np.linalg.inv(seen.T_ref_scan)


def _placed(scene: LivingScene, scan: int) -> list[tuple[int, SceneObject, np.ndarray]]:
    """Number, object and T_scan_ref of all objects in a scan."""
    poses = [(k, o, pose_in(o, scan)) for k, o in enumerate(scene.objects)]
    there = [(k, o, T) for k, o, T in poses if T is not None]
    if not there:
        raise ValueError(f"scan {scan} ({scene.scans[scan].name}) shows no object; needed another scan")
    return there


def _write_glb(scene: LivingScene, path: Path, scan: int) -> None:
    """Vertices lie about the object's own centre: glTF has single precision, its nodes take the rest."""
    graph = trimesh.Scene()
    for k, o, T_scan_ref in _placed(scene, scan):
        vertices = o.points if o.mesh is None else o.mesh.vertices
        center = vertices.mean(axis=0)
        paint = [*rgb(k), 255]
        if o.mesh is None:
            shape = trimesh.PointCloud(vertices - center, colors=np.tile(paint, (len(vertices), 1)))
        else:
            shape = trimesh.Trimesh(vertices - center, o.mesh.faces, process=False)
            shape.visual = TextureVisuals(material=_material(o.id, paint))
        T_ref_node = trimesh.transformations.translation_matrix(center)
        graph.add_geometry(shape, node_name=o.id, geom_name=o.id, transform=T_scan_ref @ T_ref_node)
    path.write_bytes(export_glb(graph))


def _material(name: str, paint: list[int]) -> PBRMaterial:
    return PBRMaterial(
        name=name, baseColorFactor=paint, metallicFactor=0.0, roughnessFactor=0.8, doubleSided=True
    )


def _write_ply(scene: LivingScene, path: Path, scan: int) -> None:
    there = _placed(scene, scan)
    points = np.concatenate([apply_pose(T_scan_ref, o.points) for _, o, T_scan_ref in there])
    numbers = np.repeat([k for k, _, _ in there], [len(o.points) for _, o, _ in there])
    write_points(path, points, numbers, "object")


def _write_json(scene: LivingScene, path: Path, scan: int) -> None:
    content = scene_to_json(scene)
    objects = [{k: v for k, v in o.items() if k not in ("mesh", "points")} for o in content.pop("objects")]
    path.write_text(
        json.dumps(content | {"objects": objects}, indent=1, allow_nan=False) + "\n", encoding="utf-8"
    )


# --- USD ----------------------------------------------------------------------------------------------------


def _write_usd(scene: LivingScene, path: Path, scan: int) -> None:
    pxr = _pxr()
    path.unlink(missing_ok=True)
    stage = pxr.Usd.Stage.CreateNew(str(path))
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.z)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(scene.scans) - 1)
    stage.SetTimeCodesPerSecond(1)
    root = pxr.UsdGeom.Xform.Define(stage, "/scene")
    stage.SetDefaultPrim(root.GetPrim())
    for k, o in enumerate(scene.objects):
        _add_to_stage(pxr, stage, scene, k, o)
    stage.GetRootLayer().Save()


def _add_to_stage(pxr: ModuleType, stage: object, scene: LivingScene, number: int, o: SceneObject) -> None:
    """One node with a pose and a visibility at every scan, and the geometry under it about its own centre."""
    vertices = o.points if o.mesh is None else o.mesh.vertices
    center = vertices.mean(axis=0)
    node = pxr.UsdGeom.Xform.Define(stage, f"/scene/{o.id}")
    pose, visible = node.AddTransformOp(pxr.UsdGeom.XformOp.PrecisionDouble), node.CreateVisibilityAttr()
    for s in range(len(scene.scans)):
        T_scan_ref = pose_in(o, s)
        visible.Set("invisible" if T_scan_ref is None else "inherited", s)
        if T_scan_ref is not None:
            T_scan_node = T_scan_ref @ trimesh.transformations.translation_matrix(center)
            pose.Set(pxr.Gf.Matrix4d(T_scan_node.T.tolist()), s)  # USD multiplies rows: v M
    kind = pxr.UsdGeom.Points if o.mesh is None else pxr.UsdGeom.Mesh
    shape = kind.Define(stage, f"/scene/{o.id}/shape")
    shape.CreatePointsAttr([pxr.Gf.Vec3f(*v) for v in (vertices - center).tolist()])
    shape.CreateDisplayColorAttr([pxr.Gf.Vec3f(*(c / 255 for c in rgb(number)))])
    if o.mesh is None:
        shape.CreateWidthsAttr([0.01] * len(vertices))
    else:
        shape.CreateFaceVertexCountsAttr([3] * len(o.mesh.faces))
        shape.CreateFaceVertexIndicesAttr(o.mesh.faces.reshape(-1).tolist())
        shape.CreateSubdivisionSchemeAttr("none")


def _pxr() -> ModuleType:
    try:
        import pxr.Gf
        import pxr.Usd
        import pxr.UsdGeom
    except ImportError as error:
        raise ValueError("format 'usd' needs the extra usd: pip install 'more2-jax[usd]'") from error
    return pxr


Writer = Callable[[LivingScene, Path, int], None]
WRITERS: dict[str, Writer] = {"glb": _write_glb, "usd": _write_usd, "ply": _write_ply, "json": _write_json}
