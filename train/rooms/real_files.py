"""Scenes of regime `real` on disk: scans as a user has them, truth beside.

scene_0000/scan_0.ply            a mesh: vertices with normals, colors and `instance` (0: none), and faces
scene_0000/scan_0.truth.npz      owner (v,): the true object of every vertex, −1 for none; object, T_scan_model, seen;
                                 T_scan_camera of every frame; T_scan_room
scene_0000/scene.json            as in `scene_files`; and of every scan T_scan_room, looked_at, looked_at_next
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData, PlyElement

from train.rooms.fused_scan import FusedScan
from train.rooms.mask_truth import Shown
from train.rooms.real_visits import RealScene
from train.rooms.scene_files import GRID_M, VERSION, feed, finished, object_truth, started, write_meshes
from train.rooms.visits import TrueObject


def write_real_scene(folder: Path, scene: RealScene, facts: Mapping[str, Any]) -> str:
    """Writes a scene atomically, and returns its digest; a folder of that name is replaced."""
    partial, digest = started(folder), hashlib.sha256()
    files = write_meshes(partial, scene.objects, digest)
    for k, scan in enumerate(scene.scans):
        vertices, faces = mesh_tables(scan)
        elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
        PlyData(elements, byte_order="<").write(str(partial / f"scan_{k}.ply"))
        arrays = truth_arrays(scene, k)
        np.savez_compressed(partial / f"scan_{k}.truth.npz", **arrays)  # pyright: ignore[reportArgumentType]
        feed(digest, {"vertex": vertices, "face": faces, **arrays})
    return finished(partial, folder, real_truth(scene, facts, files), digest)


def mesh_tables(scan: FusedScan) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the PLY file: vertices and faces."""
    columns = {
        **dict(zip("xyz", (np.round(scan.mesh.vertices / GRID_M) * GRID_M).T.astype("<f4"), strict=True)),
        **dict(zip(("nx", "ny", "nz"), np.round(scan.mesh.normals, 4).T.astype("<f4"), strict=True)),
        **dict(zip(("red", "green", "blue"), np.round(255 * scan.mesh.colors).T.astype("u1"), strict=True)),
        "instance": scan.instance.astype("<i4"),
    }
    vertices = np.empty(len(scan.instance), [(name, c.dtype) for name, c in columns.items()])
    for name, column in columns.items():
        vertices[name] = column
    faces = np.empty(len(scan.mesh.faces), [("vertex_indices", "<i4", (3,))])
    faces["vertex_indices"] = scan.mesh.faces
    return vertices, faces


def truth_arrays(scene: RealScene, index: int) -> dict[str, np.ndarray]:
    """What is true of one scan; k rows, one an object that is there, in the order of the scene's."""
    scan = scene.scans[index]
    there = [o for o in scene.objects if index in o.T_scan_model]
    return {
        "owner": scan.owner.astype(np.int16),  # a row of `object`
        "object": np.array([o.name for o in there]),
        "model": np.array([o.model for o in there]),
        "T_scan_model": np.stack([o.T_scan_model[index] for o in there]),
        "seen": np.stack([np.packbits(o.seen[index]) for o in there]),
        "T_scan_camera": np.round(scan.T_scan_room @ scene.T_room_camera[index], 9),
        "T_scan_room": scan.T_scan_room,
    }


def real_truth(scene: RealScene, facts: Mapping[str, Any], files: Mapping[str, str]) -> dict[str, Any]:
    """What scene.json says, less the digest."""
    scans = [
        {
            "file": f"scan_{k}.ply",
            "T_scan_room": scan.T_scan_room.tolist(),
            "looked_at": {n: round(share, 4) for n, share in scene.looked_at[k].items()},
            "looked_at_next": {n: round(share, 4) for n, share in scene.looked_at_next[k].items()},
        }
        for k, scan in enumerate(scene.scans)
    ]
    head = {"version": VERSION, "unit": "m", "name": scene.name, "regime": "real"}
    return {
        **head,
        **facts,
        "room_m": list(scene.room_m),
        "frames": scene.frames,
        "scans": scans,
        "objects": [_object(o, files, scene.shown) for o in scene.objects],
    }


def _object(o: TrueObject, files: Mapping[str, str], shown: tuple[dict[str, Shown], ...]) -> dict[str, Any]:
    """As in other regimes, and all masks that show the object, and the scans that have it and do not show it."""
    row = object_truth(o, files)
    for r in row["observations"]:
        how = shown[r["scan"]][o.name]
        r["instances"] = list(how.instances)
        if how.merged:
            r["merged"] = True
        if r["scan"] in o.reshaped:
            r["reshaped"] = True
    row["unseen"] = [
        {"scan": k, "T_scan_model": T.tolist(), "visible": round(o.visible(k), 4)}
        for k, T in sorted(o.T_scan_model.items())
        if k not in o.instance
    ]
    return row
