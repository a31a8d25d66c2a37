"""What scene.json says of a living scene (schema version 1): everything but points, meshes and embeddings."""

from __future__ import annotations

from typing import Any

import numpy as np

from more2_jax.progress import STAGES
from more2_jax.types import Frame, LivingScene, Repair, SceneObject

VERSION = 1


def mesh_name(o: SceneObject) -> str:
    """Of an object's mesh in the folder."""
    return f"objects/{o.id}.ply"


def points_name(o: SceneObject) -> str:
    """Of an object's accumulated points in the folder."""
    return f"objects/{o.id}_points.ply"


def scene_to_json(scene: LivingScene) -> dict[str, Any]:
    """The content of scene.json: everything but points, meshes and embeddings. Poses are 4×4, row-major."""
    return {
        "version": VERSION,
        "unit": scene.unit,
        "preset": scene.preset,
        "prior": scene.prior,
        "upright": scene.upright,
        "scans": [
            {
                "index": s.index,
                "name": s.name,
                "source": s.source,
                "instances": [int(i) for i in s.instances],
                "skipped": [{"what": k.what, "reason": k.reason} for k in s.skipped],
                "sensors": np.asarray(s.sensors, np.float64).tolist(),
                "frame": _frame_to_json(s.frame, scene.upright),
            }
            | _where_any(not_seen=list(s.not_seen), repairs=[_repair_to_json(r) for r in s.repairs])
            for s in scene.scans
        ],
        "objects": [_object_to_json(o) for o in scene.objects],
        "changes": [
            {
                "from": c.from_scan,
                "to": c.to_scan,
                "moved": list(c.moved),
                "static": list(c.static),
                "added": list(c.added),
                "removed": list(c.removed),
                "probability": {k: float(p) for k, p in c.probability.items()},
            }
            | _where_any(not_seen=list(c.not_seen), discovered=list(c.discovered))
            for c in scene.changes
        ],
        "timing_s": {k: float(scene.timing_s.get(k, 0.0)) for k in (*STAGES, *scene.timing_s)},
    }


def _where_any(**lists: list[Any]) -> dict[str, list[Any]]:
    """Those that hold anything: older readers know no others."""
    return {k: v for k, v in lists.items() if v}


def _repair_to_json(r: Repair) -> dict[str, Any]:
    lists = {"instances": [int(i) for i in r.instances], "absorbed": list(r.absorbed)}
    others = {k: getattr(r, k) for k in ("divided", "dropped", "neighbor", "regained", "unmasked", "points")}
    told = {k: v for k, v in others.items() if v}  # older readers know no others
    told |= {"smooth": float(r.smooth)} if r.smooth else {}
    return {"object": r.object, **lists, **told, "share": float(r.share)}


def _frame_to_json(frame: Frame, upright: bool) -> dict[str, Any]:
    """A scan's frame; by how much the scan was leveled, where it was, is for people: `T_scene_scan` holds it."""
    content = {
        "T_scene_scan": np.asarray(frame.T_scene_scan, np.float64).tolist(),
        "sigma_m": float(frame.sigma_m),
        "sigma_deg": float(frame.sigma_deg),
    }
    content |= {"noise_m": float(frame.noise_m)} if frame.noise_m > 0 else {}
    content |= {"unknown": True} if frame.unknown else {}  # older readers know no such frame
    return content | ({"tilt_deg": frame.tilt_deg} if upright and frame.tilt_deg > 0 else {})


def _object_to_json(o: SceneObject) -> dict[str, Any]:
    return {
        "id": o.id,
        "label": o.label,
        "reference_scan": int(o.reference_scan),
        "observations": [
            {
                "scan": int(seen.scan),
                "instance": int(seen.instance),
                "T_ref_scan": np.asarray(seen.T_ref_scan, np.float64).tolist(),
                "score": float(seen.score),
                "rms_m": float(seen.rms_m),
                "converged": bool(seen.converged),
                "interchangeable": bool(seen.interchangeable),
                "sigma_m": float(seen.sigma_m),
                "sigma_deg": float(seen.sigma_deg),
                "misfit": float(seen.misfit),
                "accumulated": bool(seen.accumulated),
            }
            for seen in o.observations
        ],
        "mesh": None if o.mesh is None else mesh_name(o),
        "points": points_name(o),
        "color": None if o.color is None else {"points": o.color.points, "lab": o.color.lab.tolist()},
    }
