"""3RScan as a benchmark (paper §4): places of a split, the true associations, ambiguity chains, predicted masks.

`<data>/3RScan.json`, or beside the folder of scans; `<data>/<scan>/…` as published (`threerscan_cloud`). An object's
model frame is the frame of the reference scan; that of objects which look alike, the pose of the one with the smallest
id.
"""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np

from eval.data.masks import associated
from eval.data.threerscan_cloud import read_scans
from eval.data.threerscan_index import CATEGORIES, SYMMETRY_FOLDS, Place, Rescan, read_index
from eval.data.truth import Benchmark, KnownObject, KnownScene
from more2_jax.geometry.poses import apply_pose, rotation_error_deg
from more2_jax.storage.ply_files import read_mesh
from more2_jax.types import Mesh, Scan
from train.furniture.symmetry import SymmetryGroup

RIGHT_DEG = 10.0
MOVED_DEG, MOVED_M = 1.0, 0.05  # beyond either, an object moved (published evaluation)
FORGIVEN_DEG = {0: (), 1: (180.0,), 2: (90.0, 180.0)}  # by the published evaluation, by class of symmetry


def threerscan(data: Path, *, split: str, predicted: bool) -> Benchmark:
    """The places of a split that are on disk. Raises ValueError if 3RScan.json is missing or no place is left."""
    index = next((p for p in (data / "3RScan.json", data.parent / "3RScan.json") if p.is_file()), None)
    if index is None:
        raise ValueError(f"{data}: no 3RScan.json in it or beside it; needed the data set's index")
    places = {p.reference: p for p in read_index(index, data, split).places if p.rescans}
    if not places:
        raise ValueError(f"{data}: no place of split {split} with a rescan; needed one")
    return Benchmark(
        names=tuple(sorted(places)),
        read=lambda name: read_place(data, places[name], predicted=predicted),
        facts={"dataset": "3RScan", "regime": split, "masks": "predicted" if predicted else "annotated"},
        upright=True,
        right_deg=RIGHT_DEG,
        files=lambda name: folders_of(data, places[name]),
    )


def folders_of(data: Path, place: Place) -> list[Path]:
    """Of its scans: the reference first, rescans in the file's order."""
    return [data / name for name in (place.reference, *(r.id for r in place.rescans))]


def read_place(data: Path, place: Place, *, predicted: bool = False) -> KnownScene:
    """One place: the reference scan first, rescans in the file's order; movable categories only.

    `predicted` looks through predicted masks instead, all of them; each object is shown by the mask that overlaps it
    most. A rescan in which nothing movable is annotated is left out, as in the published evaluation.
    """
    poses = [np.eye(4), *(r.T_ref_rescan for r in place.rescans)]
    first, *later = [
        read_scans(folder, T, predicted=predicted)
        for folder, T in zip(folders_of(data, place), poses, strict=True)
    ]
    shown = [bool(movable(annotated).instances) for annotated, _ in later]
    place = dataclasses.replace(place, rescans=tuple(itertools.compress(place.rescans, shown)))
    read = [first, *itertools.compress(later, shown)]
    scans = [movable(annotated) for annotated, _ in read]
    labels = [{i.id: i.label or "" for i in scan.instances} for scan in scans]
    objects = tuple(_object(data, place, i, labels, scans[0]) for i in sorted(labels[0]))
    scene = KnownScene(name=place.reference, scans=tuple(scans), objects=objects)
    return associated(scene, [masked for _, masked in read if masked is not None]) if predicted else scene


def true_mesh(data: Path, place: Place, id_: int, T_ref_model: np.ndarray) -> Mesh | None:
    """The object's annotated surface, in its model frame, where the data have it: the published evaluation's files."""
    file = data.parent / "val_set_recon" / place.reference / f"objectId_{id_}.ply"
    if not file.is_file():
        return None
    mesh = read_mesh(file)
    return Mesh(
        vertices=apply_pose(np.linalg.inv(T_ref_model), mesh.vertices), faces=mesh.faces.astype(np.int64)
    )


def movable(scan: Scan) -> Scan:
    """A scan with its instances of movable categories."""
    return dataclasses.replace(scan, instances=tuple(i for i in scan.instances if i.label in CATEGORIES))


def _object(data: Path, place: Place, id_: int, labels: list[dict[int, str]], reference: Scan) -> KnownObject:
    """An object of the reference, with what is annotated of it in every rescan.

    Where its shape changed and no motion is listed, it has the pose of what did not move: it counts for matching alone.
    """
    root, T_ref_model = _model_frame(place, id_)
    poses, instance, moved, rigid = {0: T_ref_model}, {0: id_}, {0: False}, set[int]()
    reshaped, symmetry = set[int](), 0
    for k, rescan in enumerate(place.rescans, start=1):
        found = [i for i in labels[k] if rescan.instance_in_reference(i) == id_]
        if not found or id_ in rescan.removed:
            continue
        instance[k] = found[0]
        poses[k] = np.linalg.inv(rescan.pose_of(found[0])) @ T_ref_model
        moved[k] = has_moved(rescan, found[0])
        listed = [m.symmetry for m in rescan.moved if m.instance_ref == id_]
        rigid |= {k} if listed else set()
        reshaped |= {k} if id_ in rescan.nonrigid and not listed else set()
        symmetry = max(symmetry, *listed[:1], 0)
    center = _center(reference, id_, T_ref_model)
    return KnownObject(
        name=f"instance_{id_}",
        category=labels[0][id_],
        copies=f"instance_{root}",
        instance=instance,
        T_scan_model=poses,
        mesh=true_mesh(data, place, id_, T_ref_model),
        symmetry=SymmetryGroup.turns(SYMMETRY_FOLDS.get(symmetry, 1), center),
        forgiven_deg=FORGIVEN_DEG.get(symmetry, ()),
        moved=moved,
        rigid=frozenset(rigid),
        reshaped=frozenset(reshaped),
    )


def _model_frame(place: Place, id_: int) -> tuple[int, np.ndarray]:
    """The one of the objects that look alike whose pose is the model frame, and the pose from it onto this one."""
    root = min(place.interchangeable(id_))
    return root, place.interchangeable(root)[id_]


def _center(reference: Scan, id_: int, T_ref_model: np.ndarray) -> np.ndarray:
    points = next((i.points for i in reference.instances if i.id == id_), np.zeros((1, 3)))
    box = np.stack([points.min(axis=0), points.max(axis=0)]).mean(axis=0, keepdims=True)
    return apply_pose(np.linalg.inv(T_ref_model), box)[0]


def has_moved(rescan: Rescan, instance: int) -> bool:
    """Whether the annotated pose differs from that of what did not move."""
    T = np.linalg.inv(rescan.T_ref_rescan) @ rescan.pose_of(instance)
    return rotation_error_deg(T[:3, :3], np.eye(3)) > MOVED_DEG or float(np.linalg.norm(T[:3, 3])) > MOVED_M
