"""Rooms of `train.synthesize` in 3RScan's folder layout: `python -m train.tools.as_threerscan --data rooms/real`.

3RScan's license keeps it from tests and examples; what reads it is proved on rooms whose truth is known. Written is
what the benchmark reads (`eval.data.threerscan`): `3RScan.json`, and for every scan its annotated mesh and
`semseg.v2.json`; beside the folder the objects' surfaces, `val_set_recon/<reference>/objectId_<id>.ply`. Frames are
upright and every scan's own, as the data set's are. No depth frames, no textures, no segments.
"""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

from more2_jax.geometry.poses import Points, Pose, apply_pose
from more2_jax.storage.ply_files import write_mesh
from more2_jax.types import Mesh
from train.rooms.scene_files import read_scene
from train.rooms.visits import FlyingScene, TrueObject
from train.run.program import run

STRUCTURE, FIRST_OBJECT = 1, 2  # objectId of what surrounds objects, and of the first object
# Furniture that the benchmark counts by the same name; what else there is would not be counted.
SAME_NAME = ("bed", "bench", "chair", "couch", "desk", "pillow", "sofa", "table", "trash can")
ELSE = "stand"
SYMMETRY_CLASS = {1: 0, 2: 1}  # by turns about the vertical that look alike; more are class 2
NO_VALUE = (
    ("globalId", "u2"),
    ("NYU40", "u1"),
    ("Eigen13", "u1"),
    ("RIO27", "u1"),
)  # properties that nobody reads


def main(data: Path, out: Path, split: str = "validation", seed: int = 0) -> None:
    """Writes every scene of `data` as one place.

    Args:
        data: folder of scenes.
        out: folder of the scans; surfaces go into `val_set_recon` beside it.
        split: train, validation or test.
        seed: of the scans' frames.
    """
    scenes = [read_scene(file.parent) for file in sorted(data.glob("*/scene.json"))]
    if not scenes:
        raise ValueError(f"{data}: no scene.json in any folder; needed rooms of train.synthesize")
    rng = np.random.default_rng(seed)
    places = [write_place(out, scene, split, rng) for scene in scenes]
    (out / "3RScan.json").write_text(json.dumps(places, indent=1), encoding="utf-8")


def write_place(out: Path, scene: FlyingScene, split: str, rng: np.random.Generator) -> dict[str, object]:
    """The scans and surfaces of one scene; returns its entry of `3RScan.json`."""
    names = [f"{scene.name}_{k}" for k in range(len(scene.scans))]
    rooms = scene.T_scan_room or tuple(np.eye(4) for _ in names)
    own = [_frame(rng) @ np.linalg.inv(T) for T in rooms]  # from a scan's frame to the one written
    to_ref = [own[0] @ rooms[0] @ np.linalg.inv(own[k] @ rooms[k]) for k in range(len(names))]
    ids = {o.name: FIRST_OBJECT + k for k, o in enumerate(scene.objects)}
    for k, name in enumerate(names):
        _write_scan(out / name, scene, k, own[k], ids)
    for o in scene.objects:
        if 0 in o.instance:
            T = own[0] @ o.T_scan_model[0]
            mesh = Mesh(vertices=apply_pose(T, o.vertices), faces=o.faces)
            folder = out.parent / "val_set_recon" / names[0]
            folder.mkdir(parents=True, exist_ok=True)
            write_mesh(folder / f"objectId_{ids[o.name]}.ply", mesh)
    rescans = [
        {
            "reference": names[k],
            "transform": column_major(to_ref[k]),
            **_changes(scene, k, own, to_ref[k], ids),
        }
        for k in range(1, len(names))
    ]
    return {"reference": names[0], "type": split, "ambiguity": _alike(scene, own[0], ids), "scans": rescans}


def _changes(
    scene: FlyingScene, k: int, own: list[Pose], T_ref_rescan: Pose, ids: dict[str, int]
) -> dict[str, list[object]]:
    """What moved and what is gone in scan `k`; objects that stayed are not named."""
    rigid: list[object] = []
    for o in scene.objects:
        if 0 not in o.instance or k not in o.instance:
            continue
        # From where the object was in the reference to where it is, in the rescan's own frame.
        T = own[k] @ o.T_scan_model[k] @ np.linalg.inv(own[0] @ o.T_scan_model[0])
        if not np.allclose(T @ T_ref_rescan, np.eye(4), atol=1e-6):
            rigid.append(
                {
                    "instance_reference": ids[o.name],
                    "instance_rescan": ids[o.name],
                    "symmetry": SYMMETRY_CLASS.get(o.symmetry_order or 1, 2),
                    "transform": column_major(T),
                }
            )
    gone: list[object] = [ids[o.name] for o in scene.objects if 0 in o.instance and k not in o.T_scan_model]
    return {"rigid": rigid, "nonrigid": [], "removed": gone}


def _alike(scene: FlyingScene, own: Pose, ids: dict[str, int]) -> list[list[dict[str, object]]]:
    """Objects of one model in the reference, each with the next of it."""
    by_model: dict[str, list[TrueObject]] = {}
    for o in scene.objects:
        if 0 in o.instance:
            by_model.setdefault(o.model, []).append(o)
    return [
        [
            {
                "instance_source": ids[a.name],
                "instance_target": ids[b.name],
                "transform": column_major(own @ b.T_scan_model[0] @ np.linalg.inv(own @ a.T_scan_model[0])),
            }
        ]
        for same in by_model.values()
        for a, b in itertools.pairwise(same)
    ]


def _write_scan(folder: Path, scene: FlyingScene, k: int, own: Pose, ids: dict[str, int]) -> None:
    scan = scene.scans[k]
    named = {o.instance[k]: o for o in scene.objects if k in o.instance}
    clouds: list[Points] = [scan.background, *(i.points for i in scan.instances)]
    object_ids = [STRUCTURE, *(ids[named[i.id].name] if i.id in named else STRUCTURE for i in scan.instances)]
    rows = np.repeat(object_ids, [len(c) for c in clouds])
    folder.mkdir(parents=True, exist_ok=True)
    _write_annotated(
        folder / "labels.instances.annotated.v2.ply", apply_pose(own, np.concatenate(clouds)), rows
    )
    labels = {STRUCTURE: "wall"} | {ids[o.name]: _label(o.category) for o in named.values()}
    groups = [{"id": i, "objectId": i, "label": label, "segments": []} for i, label in labels.items()]
    text = json.dumps({"scan_id": folder.name, "appId": "Aggregator.v2", "segGroups": groups})
    (folder / "semseg.v2.json").write_text(text, encoding="utf-8")


def _write_annotated(path: Path, points: Points, object_id: np.ndarray) -> None:
    """Vertices as the data set has them, in ASCII; no faces."""
    kinds = [(n, "f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")] + [("objectId", "u2")]
    table = np.zeros(len(points), [*kinds, *NO_VALUE])
    for name, column in zip("xyz", points.T, strict=True):
        table[name] = column
    table["objectId"] = object_id
    faces = np.zeros(0, [("vertex_indices", "i4", (3,))])
    PlyData([PlyElement.describe(table, "vertex"), PlyElement.describe(faces, "face")], text=True).write(
        str(path)
    )


def _frame(rng: np.random.Generator) -> Pose:
    """Any turn about the vertical, some meters off."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix()
    T[:3, 3] = rng.uniform(-3, 3, 3) * [1, 1, 0.1]
    return T


def _label(category: str) -> str:
    return category if category in SAME_NAME else ELSE


def column_major(T: Pose) -> list[float]:
    """16 numbers, column by column."""
    return [float(x) for x in T.T.reshape(-1)]


if __name__ == "__main__":
    run(main)
