"""Rooms of `train.synthesize` in 3RScan's folder layout: `python -m train.tools.as_threerscan --data rooms/real`.

3RScan's license keeps it from tests and examples; what reads it is proved on rooms whose truth is known. Written is
what the benchmark reads (`eval.data.threerscan`), as the paper's evaluation lays it out:

<out>/3RScan.json                        the places: what moved, changed its shape, is gone, looks alike
<out>/val_set/<scan>/…                   a folder a scan (`train.rooms.threerscan_files`)
<out>/val_set_recon/<reference>/…        objectId_<id>.ply: the objects' surfaces

Frames are upright and every scan's own, as the data set's are. Depth frames and their clouds are of regime `real`
alone, whose scans are meshes. No color images, no textures, no segments.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from more2_jax.geometry.poses import Pose, apply_pose
from more2_jax.scans.files.npz import read_arrays
from more2_jax.scans.files.ply_cloud import read_ply
from more2_jax.storage.ply_files import read_mesh, write_mesh
from more2_jax.types import Mesh
from train.furniture.symmetry import yaw_symmetry
from train.rooms.depth_sensor import DepthSensor
from train.rooms.scene_files import read_scene
from train.rooms.threerscan_files import AnnotatedScan, write_annotated, write_depth
from train.rooms.visits import FlyingScene, TrueObject
from train.run.program import run

STRUCTURE, FIRST_OBJECT = 1, 2  # objectId of what surrounds objects, and of the first object
# Furniture that the benchmark counts by the same name; what else there is would not be counted.
SAME_NAME = ("armchair", "bed", "bench", "chair", "couch", "desk", "pillow", "sofa", "table", "trash can")
ELSE = "stand"
SYMMETRY_CLASS = {1: 0, 2: 1}  # by turns about the vertical that look alike; more are class 2
LEAST_WIDTH = 16  # of a depth image, pixels
FOLDERS = {"train": "train_set", "validation": "val_set", "test": "test_set"}


@dataclass(frozen=True, kw_only=True)
class Place:
    """A scene with the frames and numbers that its files have."""

    scene: FlyingScene
    names: tuple[str, ...]  # of the scans, the reference first
    own: tuple[Pose, ...]  # takes a scan's frame to the one that is written
    ids: dict[str, int]  # objectId of every object

    @property
    def T_ref_scan(self) -> list[Pose]:
        """Takes what did not move, in the frame of each scan as written, to the reference's."""
        rooms = self.scene.T_scan_room or tuple(np.eye(4) for _ in self.names)
        written = [own @ T for own, T in zip(self.own, rooms, strict=True)]
        return [written[0] @ np.linalg.inv(T) for T in written]

    def pose(self, o: TrueObject, k: int) -> Pose:
        """Where an object stands in scan `k`, in the frame that is written."""
        return self.own[k] @ o.T_scan_model[k]


def main(
    data: Path, out: Path, split: str = "validation", seed: int = 0, width: int = 224, frames: int = 60
) -> None:
    """Writes every scene of `data` as one place.

    Args:
        data: folder of scenes.
        out: folder of 3RScan.json, of the split's folder of scans, and of the surfaces.
        split: train, validation or test.
        seed: of the scans' frames and of the noise of depth.
        width: of a depth image, pixels.
        frames: of depth, at most, evenly over the walk.
    """
    if split not in FOLDERS or width < LEAST_WIDTH or frames < 1:
        raise ValueError(
            f"split {split}, width {width}, frames {frames}; needed one of {', '.join(FOLDERS)}, a width of"
            f" {LEAST_WIDTH} or more, a frame at least"
        )
    scenes = [read_scene(file.parent) for file in sorted(data.glob("*/scene.json"))]
    if not scenes:
        raise ValueError(f"{data}: no scene.json in any folder; needed rooms of train.synthesize")
    rng = np.random.default_rng(seed)
    sensor = DepthSensor(width=width, height=round(width * 172 / 224))  # the shape of the data set's images
    places = [_placed(scene, rng) for scene in scenes]
    for place in places:
        for k in range(len(place.names)):
            _write_scan(out / FOLDERS[split], place, k, sensor, frames, rng)
        _write_surfaces(out / "val_set_recon" / place.names[0], place)
    index = [_entry(place, split) for place in places]
    (out / "3RScan.json").write_text(json.dumps(index, indent=1), encoding="utf-8")


def _write_scan(
    folder: Path, place: Place, k: int, sensor: DepthSensor, frames: int, rng: np.random.Generator
) -> None:
    """Scan `k`, and of a mesh its depth in at most so many frames."""
    scan = _annotated(place, k)
    write_annotated(folder / place.names[k], scan)
    if len(scan.faces):
        cameras = place.own[k] @ place.scene.T_scan_camera[k]
        rows = np.linspace(0, len(cameras) - 1, min(frames, len(cameras))).round().astype(int)
        write_depth(folder / place.names[k], scan, cameras[rows], place.T_ref_scan[k], sensor, rng)


def _placed(scene: FlyingScene, rng: np.random.Generator) -> Place:
    names = tuple(f"{scene.name}_{k}" for k in range(len(scene.scans)))
    rooms = scene.T_scan_room or tuple(np.eye(4) for _ in names)
    own = tuple(_frame(rng) @ np.linalg.inv(T) for T in rooms)
    ids = {o.name: FIRST_OBJECT + k for k, o in enumerate(scene.objects)}
    return Place(scene=scene, names=names, own=own, ids=ids)


def _write_surfaces(folder: Path, place: Place) -> None:
    """The objects of the reference, where they stand in it."""
    folder.mkdir(parents=True, exist_ok=True)
    for o in place.scene.objects:
        if 0 in o.instance:
            mesh = Mesh(vertices=apply_pose(place.pose(o, 0), o.vertices), faces=o.faces)
            write_mesh(folder / f"objectId_{place.ids[o.name]}.ply", mesh)


def _entry(place: Place, split: str) -> dict[str, object]:
    """The place as `3RScan.json` has it."""
    to_ref = place.T_ref_scan
    rescans = [
        {"reference": name, "transform": column_major(to_ref[k]), **_changes(place, k, to_ref[k])}
        for k, name in enumerate(place.names)
        if k
    ]
    return {"reference": place.names[0], "type": split, "ambiguity": _alike(place), "scans": rescans}


def _changes(place: Place, k: int, T_ref_rescan: Pose) -> dict[str, list[object]]:
    """What moved, changed its shape and is gone in scan `k`; objects that stayed are not named."""
    rigid, nonrigid, removed = list[object](), list[object](), list[object]()
    for o in place.scene.objects:
        id_ = place.ids[o.name]
        if 0 in o.instance and k not in o.T_scan_model:
            removed.append(id_)
        if 0 not in o.instance or k not in o.instance:
            continue
        if k in o.reshaped:
            nonrigid.append(id_)
            continue
        # From where the object was in the reference to where it is, in the rescan's own frame.
        T = place.pose(o, k) @ np.linalg.inv(place.pose(o, 0))
        if not np.allclose(T @ T_ref_rescan, np.eye(4), atol=1e-6):
            rigid.append(
                {
                    "instance_reference": id_,
                    "instance_rescan": id_,
                    "symmetry": SYMMETRY_CLASS.get(turns(o), 2),
                    "transform": column_major(T),
                }
            )
    return {"rigid": rigid, "nonrigid": nonrigid, "removed": removed}


def turns(o: TrueObject) -> int:
    """Turns about the vertical after which an object looks the same; 0: any. Measured where the scene does not say."""
    if o.symmetry_order is not None:
        return o.symmetry_order
    return _measured(o.vertices.astype(np.float64).tobytes(), o.faces.astype(np.int64).tobytes())


@lru_cache(maxsize=512)
def _measured(vertices: bytes, faces: bytes) -> int:
    return yaw_symmetry(np.frombuffer(vertices).reshape(-1, 3), np.frombuffer(faces, np.int64).reshape(-1, 3))


def _alike(place: Place) -> list[list[dict[str, object]]]:
    """A chain for the objects of each model in the reference: each with the next of it, the last with the first.

    The published evaluation follows a chain until it comes back to where it began.
    """
    by_model: dict[str, list[TrueObject]] = {}
    for o in place.scene.objects:
        if 0 in o.instance:
            by_model.setdefault(o.model, []).append(o)
    return [
        [
            {
                "instance_source": place.ids[a.name],
                "instance_target": place.ids[b.name],
                "transform": column_major(place.pose(b, 0) @ np.linalg.inv(place.pose(a, 0))),
            }
            for a, b in zip(same, [*same[1:], same[0]], strict=True)
        ]
        for same in by_model.values()
        if len(same) > 1
    ]


def _annotated(place: Place, k: int) -> AnnotatedScan:
    """Scan `k` with what its annotators and a network say: of a mesh the truth and its masks, of a cloud its masks."""
    scan, there = place.scene.scans[k], [o for o in place.scene.objects if k in o.instance]
    named = {o.instance[k]: place.ids[o.name] for o in there if o.instance[k] > 0 and k not in o.merged}
    labels = {STRUCTURE: "wall"} | {place.ids[o.name]: _label(o.category) for o in there}
    file = Path(scan.source)
    if file.suffix == ".ply":
        mesh = read_mesh(file)
        true, masks = _of_vertices(file, {o.name: place.ids[o.name] for o in there}, named)
        vertices, faces = mesh.vertices, mesh.faces.astype(np.int64)
    else:
        clouds = [scan.background, *(i.points for i in scan.instances)]
        ids = [STRUCTURE, *(named.get(i.id, STRUCTURE) for i in scan.instances)]
        true = masks = np.repeat(ids, [len(c) for c in clouds])
        vertices, faces = np.concatenate(clouds), np.zeros((0, 3), np.int64)
    return AnnotatedScan(
        vertices=apply_pose(place.own[k], vertices),
        faces=faces,
        object_id=true,
        predicted_id=masks,
        labels=labels,
    )


def _of_vertices(file: Path, ids: dict[str, int], named: dict[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """By vertex of a mesh: the objectId of what it truly shows, and that of its mask; 0 for a mask that shows none."""
    truth, has = read_arrays(file.with_suffix(".truth.npz"), ("owner", "object"))
    if len(truth) < 2:
        raise ValueError(f"{file.with_suffix('.truth.npz')}: arrays are {has}; needed owner and object")
    of_owner = np.array(
        [*(ids.get(name, STRUCTURE) for name in truth["object"].tolist()), STRUCTURE]
    )  # −1: the last
    mask = read_ply(file).properties["instance"]
    of_mask = np.array([named.get(i, 0) for i in range(int(mask.max(initial=0)) + 1)])
    return of_owner[truth["owner"]], of_mask[mask]


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
