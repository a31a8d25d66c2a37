"""Scenes of a benchmark on disk: a folder a scene, with scans that `read_scan` reads, meshes, and the truth.

scene_0000/scene.json            what is true: objects, roles, poses, cameras, licenses; `digest` of it all
scene_0000/scan_0.npz            points, instance, label; and object, T_scan_model, seen, T_scan_camera
scene_0000/scan_0.ply            in regime `real` (`real_files`) instead: a mesh, with scan_0.truth.npz beside it
scene_0000/meshes/<model>.ply    closed, meters, model frame: standing on z = 0
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from more2_jax.scans.files.json_file import read_json
from more2_jax.scans.labeled_cloud import UNREADABLE
from more2_jax.scans.read_scan import read_scan
from more2_jax.storage.ply_files import read_mesh, write_mesh
from more2_jax.types import Mesh, Scan
from train.rooms.visits import FlyingScene, TrueObject

VERSION = 1
GRID_M = 1e-4  # coordinates of scans are multiples of it, so that a last bit does not show
POINTS_AN_OBJECT, BACKGROUND_POINTS = 8000, 12_000  # at most, drawn at random


class Digest(Protocol):
    """What hashlib makes."""

    def update(self, data: bytes, /) -> None: ...

    def hexdigest(self) -> str: ...


def write_scene(folder: Path, scene: FlyingScene, facts: Mapping[str, Any], rng: np.random.Generator) -> str:
    """Writes a scene atomically, and returns its digest; a folder of that name is replaced.

    `facts` (seed, settings) go into scene.json as they are. `rng` thins dense scans.
    """
    partial, digest = started(folder), hashlib.sha256()
    files = write_meshes(partial, scene.objects, digest)
    for index in range(len(scene.scans)):
        arrays = scan_arrays(scene, index, rng)
        np.savez_compressed(partial / f"scan_{index}.npz", **arrays)  # pyright: ignore[reportArgumentType]
        feed(digest, arrays)
    return finished(partial, folder, scene_truth(scene, facts, files), digest)


def started(folder: Path) -> Path:
    """An empty folder beside, to be filled and then renamed by `finished`."""
    partial = folder.with_name(f"{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    (partial / "meshes").mkdir(parents=True)
    return partial


def write_meshes(partial: Path, objects: Sequence[TrueObject], digest: Digest) -> dict[str, str]:
    """Writes each model once; the file of each."""
    files: dict[str, str] = {}
    for o in objects:
        if o.model not in files:
            files[o.model] = f"meshes/{file_name(o.model)}.ply"
            write_mesh(partial / files[o.model], Mesh(vertices=o.vertices, faces=o.faces.astype(np.int32)))
            feed(digest, {"vertices": o.vertices, "faces": o.faces.astype(np.int32)})
    return files


def finished(partial: Path, folder: Path, truth: dict[str, Any], digest: Digest) -> str:
    """Writes scene.json last, renames the folder, and returns the digest of it all."""
    digest.update(json.dumps(truth, sort_keys=True).encode())
    truth["digest"] = digest.hexdigest()
    (partial / "scene.json").write_text(json.dumps(truth, indent=1), encoding="utf-8")
    shutil.rmtree(folder, ignore_errors=True)
    partial.rename(folder)
    return truth["digest"]


def file_name(model: str) -> str:
    """Of a model's mesh: its name where that is plain, else with a mark of what was replaced."""
    plain = re.sub(r"[^A-Za-z0-9_.~-]", "_", model)
    return plain if plain == model else f"{plain}_{hashlib.sha1(model.encode()).hexdigest()[:6]}"


def scan_arrays(scene: FlyingScene, index: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """What the file of one scan holds; k rows of truth, one an object present, in the order of the scene's."""
    scan = scene.scans[index]
    parts = [(0, "floor", _thinned(scan.background, BACKGROUND_POINTS, rng))]
    parts += [(i.id, i.label or "", _thinned(i.points, POINTS_AN_OBJECT, rng)) for i in scan.instances]
    present = [o for o in scene.objects if index in o.instance]
    return {
        "points": np.concatenate([p for _, _, p in parts]),
        "instance": np.concatenate([np.full(len(p), i, np.int32) for i, _, p in parts]),
        "label": np.concatenate([np.full(len(p), label.encode()) for _, label, p in parts]),
        "object": np.array([o.name for o in present]),
        "model": np.array([o.model for o in present]),
        "object_instance": np.array([o.instance[index] for o in present], np.int32),
        "T_scan_model": np.stack([o.T_scan_model[index] for o in present]),
        "seen": np.stack([np.packbits(o.seen[index]) for o in present]),
        "T_scan_camera": np.round(scene.T_scan_camera[index], 9),
    }


def _thinned(points: np.ndarray, most: int, rng: np.random.Generator) -> np.ndarray:
    """At most so many of the points, in their order, on the grid."""
    rank = rng.permutation(len(points)) < most
    return (np.round(points[rank] / GRID_M) * GRID_M).astype(np.float32)


def feed(digest: Digest, arrays: Mapping[str, np.ndarray]) -> None:
    """Names, types, shapes and contents into a digest."""
    for name, array in arrays.items():
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())


def scene_truth(scene: FlyingScene, facts: Mapping[str, Any], files: Mapping[str, str]) -> dict[str, Any]:
    """What scene.json says, less the digest."""
    scans = [
        {"file": f"scan_{k}.npz", "T_scan_camera": np.round(T, 9).tolist()}
        for k, T in enumerate(scene.T_scan_camera)
    ]
    objects = [object_truth(o, files) for o in scene.objects]
    head = {"version": VERSION, "unit": "m", "name": scene.name, "regime": scene.regime}
    return {**head, **facts, "scans": scans, "objects": objects}


def object_truth(o: TrueObject, files: Mapping[str, str]) -> dict[str, Any]:
    """What scene.json says of an object and of the scans that show it."""
    return {
        "id": o.name,
        "model": o.model,
        "category": o.category,
        "role": o.role,
        "mesh": files[o.model],
        "symmetry_order": o.symmetry_order,
        "source": o.source,
        "license": o.license,
        "observations": [
            {
                "scan": k,
                "instance": i,
                "T_scan_model": o.T_scan_model[k].tolist(),
                "visible": round(o.visible(k), 4),
            }
            for k, i in sorted(o.instance.items())
        ],
    }


def read_scene(folder: str | Path) -> FlyingScene:
    """One scene. Raises ValueError, in one line, if something is missing, damaged or of another version."""
    folder = Path(folder)
    truth = read_json(folder / "scene.json")
    try:
        if truth["version"] != VERSION:
            raise ValueError(f"{folder}: version {truth['version']}; needed {VERSION}")
        files = [folder / s["file"] for s in truth["scans"]]
        beside = [f.with_suffix(".truth.npz") if f.suffix == ".ply" else f for f in files]
        seen = [_seen(file) for file in beside]
        return FlyingScene(
            scans=tuple(_scan(file) for file in files),
            objects=tuple(_object(folder, row, seen) for row in truth["objects"]),
            T_scan_camera=tuple(_cameras(s, b) for s, b in zip(truth["scans"], beside, strict=True)),
            name=truth["name"],
            regime=truth["regime"],
            T_scan_room=tuple(np.array(s["T_scan_room"]) for s in truth["scans"] if "T_scan_room" in s),
            room_m=tuple(truth["room_m"]) if truth["regime"] == "real" else None,
            looked_at=tuple(s["looked_at"] for s in truth["scans"] if "looked_at" in s),
            looked_at_next=tuple(s["looked_at_next"] for s in truth["scans"] if "looked_at_next" in s),
        )
    except (KeyError, TypeError, AttributeError) as error:
        what = " ".join(repr(error).split())
        raise ValueError(f"{folder}: not a scene of a benchmark ({what}); needed a whole one") from error


def _scan(file: Path) -> Scan:
    return read_scan(file, min_points=1)


def _cameras(row: Mapping[str, Any], beside: Path) -> np.ndarray:
    """T_scan_camera of a scan's frames: in scene.json where they are few, else in the file beside the scan."""
    if "T_scan_camera" in row:
        return np.array(row["T_scan_camera"])
    with np.load(beside, allow_pickle=False) as arrays:
        return arrays["T_scan_camera"]


def _seen(file: Path) -> dict[str, np.ndarray]:
    """Which samples of each object's surface a scan sees, by the object's name."""
    try:
        with np.load(file, allow_pickle=False) as arrays:
            rows = np.unpackbits(arrays["seen"], axis=1).astype(bool)
            return dict(zip(arrays["object"].tolist(), rows, strict=True))
    except UNREADABLE as error:
        raise ValueError(f"{file}: not a scan of a benchmark ({' '.join(str(error).split())})") from error


def _object(folder: Path, row: Mapping[str, Any], seen: list[dict[str, np.ndarray]]) -> TrueObject:
    mesh = read_mesh(folder / row["mesh"])
    rows = row["observations"]
    there = [*rows, *row.get("unseen", [])]
    return TrueObject(
        name=row["id"],
        model=row["model"],
        category=row["category"],
        vertices=mesh.vertices,
        faces=mesh.faces.astype(np.int64),
        instance={r["scan"]: r["instance"] for r in rows},
        T_scan_model={r["scan"]: np.array(r["T_scan_model"]) for r in there},
        role=row["role"],
        seen={r["scan"]: seen[r["scan"]][row["id"]] for r in there},
        parts={r["scan"]: tuple(r["instances"]) for r in rows if "instances" in r},
        merged=frozenset(r["scan"] for r in rows if r.get("merged")),
        reshaped=frozenset(r["scan"] for r in rows if r.get("reshaped")),
        symmetry_order=row["symmetry_order"],
        license=row.get("license", row.get("licence", "unknown")),
        source=row["source"],
    )
