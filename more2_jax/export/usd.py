"""USD: one node an object, poses and visibility as time samples, one a scan."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from more2_jax.export.placing import PALE, Track, quaternions, track
from more2_jax.report import rgb
from more2_jax.tracking.objects import number_of
from more2_jax.types import LivingScene, SceneObject

POINT_WIDTH_M = 0.01
SUFFIXES = (".usda", ".usdc", ".usd")  # by which USD chooses text or binary


def write_usd(scene: LivingScene, path: Path, scan: int) -> None:
    """All scans at time codes 0, 1, …, one a second; meters, z up. `scan` chooses nothing."""
    if path.suffix not in SUFFIXES:
        raise ValueError(f"{path}: suffix {path.suffix!r}; needed one of {', '.join(SUFFIXES)}")
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
    for o in scene.objects:
        node = track(o, scene.scans)
        prim = _add_node(pxr, stage, o.id, node.poses("seen"), node.shown("seen"))
        _describe(pxr, prim, o, node)
        _add_shape(pxr, stage, o, node.vertices, rgb(number_of(o)))
        if (unseen := node.shown("not_seen")).any():
            _add_node(pxr, stage, f"{o.id}_not_seen", node.poses("not_seen"), unseen)
            _add_pale(pxr, stage, o)
    stage.GetRootLayer().Save()


def _add_node(
    pxr: ModuleType,
    stage: Any,
    name: str,
    poses: Float[np.ndarray, "scans 4 4"],
    present: Bool[np.ndarray, " scans"],
) -> Any:
    """Translation and quaternion, not a matrix: between samples a matrix would be sheared."""
    node = pxr.UsdGeom.Xform.Define(stage, f"/scene/{name}")
    double = pxr.UsdGeom.XformOp.PrecisionDouble
    translate, orient = node.AddTranslateOp(double), node.AddOrientOp(double)
    visible = node.CreateVisibilityAttr()
    for s, (T, (x, y, z, w)) in enumerate(zip(poses, quaternions(poses).tolist(), strict=True)):
        translate.Set(pxr.Gf.Vec3d(*T[:3, 3].tolist()), s)
        orient.Set(pxr.Gf.Quatd(w, x, y, z), s)
        visible.Set("inherited" if present[s] else "invisible", s)
    return node.GetPrim()


def _describe(pxr: ModuleType, prim: Any, o: SceneObject, node: Track) -> None:
    """The object's label, and its state at every scan: `seen`, `not_seen` or `absent`."""
    if o.label is not None:
        prim.SetCustomDataByKey("label", o.label)
    told = prim.CreateAttribute("more2:state", pxr.Sdf.ValueTypeNames.Token)
    for s, state in enumerate(node.states):
        told.Set(state, s)


def _add_pale(pxr: ModuleType, stage: Any, o: SceneObject) -> None:
    """The object's shape once more, pale."""
    shape = stage.DefinePrim(f"/scene/{o.id}_not_seen/shape")
    shape.GetReferences().AddInternalReference(f"/scene/{o.id}/shape")
    pxr.UsdGeom.Gprim(shape).CreateDisplayOpacityAttr([PALE])


def _add_shape(
    pxr: ModuleType,
    stage: Any,
    o: SceneObject,
    vertices: Float[np.ndarray, "v 3"],
    color: tuple[int, int, int],
) -> None:
    kind = pxr.UsdGeom.Points if o.mesh is None else pxr.UsdGeom.Mesh
    shape = kind.Define(stage, f"/scene/{o.id}/shape")
    shape.CreatePointsAttr([pxr.Gf.Vec3f(*v) for v in vertices.tolist()])
    shape.CreateExtentAttr([pxr.Gf.Vec3f(*v) for v in (vertices.min(0).tolist(), vertices.max(0).tolist())])
    shape.CreateDisplayColorAttr([pxr.Gf.Vec3f(*(c / 255 for c in color))])
    if o.mesh is None:
        shape.CreateWidthsAttr([POINT_WIDTH_M] * len(vertices))
    else:
        shape.CreateFaceVertexCountsAttr([3] * len(o.mesh.faces))
        shape.CreateFaceVertexIndicesAttr(o.mesh.faces.reshape(-1).tolist())
        shape.CreateSubdivisionSchemeAttr("none")
        shape.CreateDoubleSidedAttr(True)


def _pxr() -> ModuleType:
    try:
        import pxr.Gf
        import pxr.Sdf
        import pxr.Usd
        import pxr.UsdGeom
    except ImportError as error:
        raise ValueError("format 'usd' needs the extra usd: pip install 'more2-jax[usd]'") from error
    return pxr
