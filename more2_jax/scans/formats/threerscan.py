"""3RScan (Wald et al. 2019; paper §4): a scan's folder, read from its annotated mesh or its raw depth frames.

`labels.instances.annotated.v2.ply` gives every vertex its `objectId` (0: none), `semseg.v2.json` the labels.
The mesh's colors paint the instances (`ply_color` of 3DSSG's `objects.json`), in which the truth shows: never read.
Points are in the scan's own frame, z up, meters; `eval.data.threerscan_index` has the poses between scans.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Integer
from scipy.spatial import KDTree

from more2_jax.scans.files.ply_cloud import PlyCloud, read_ply
from more2_jax.scans.files.rgbd_sequence import (
    DEPTH,
    POSE,
    Sequence,
    back_project,
    open_sequence,
    read_pgm,
    read_pose,
)
from more2_jax.scans.formats import ply_scan
from more2_jax.scans.labeled_cloud import LabeledCloud, ReadOptions, instance_ids
from more2_jax.scans.segment_groups import read_groups
from more2_jax.scans.structural_labels import drop_background
from more2_jax.types import Skipped

ANNOTATED = ("labels.instances.annotated.v2.ply", "labels.instances.annotated.ply")
LABELS = ("semseg.v2.json", "semseg.json")
MESHES = ("mesh.refined.v2.obj", "mesh.refined.obj")
OBJECT = "objectId"
MOST_FRAMES = 100  # evenly spaced over the sequence
MOST_POINTS = 2_000_000  # of all frames together
NEAREST_M = 0.05  # a depth point further from every annotated vertex is background


def recognizes(path: Path) -> bool:
    """Whether this is a folder with an annotated mesh, a mesh or a sequence of 3RScan."""
    if not path.is_dir():
        return path.name in ANNOTATED and path.is_file()
    return any((path / name).is_file() for name in (*ANNOTATED, *LABELS, *MESHES, "sequence.zip"))


def read(path: Path, options: ReadOptions) -> LabeledCloud:
    """Vertices of the annotated mesh, or with `depth_frames` back-projected depth that takes their instances.

    Instances keep the dataset's ids, which name the same object in every scan of a place. Raises ValueError,
    in one line, on what is missing or damaged; scans of the hidden test set have no annotation, and no masks.
    """
    folder = path if path.is_dir() else path.parent
    annotated = _first(folder, ANNOTATED) if path.is_dir() else path
    if annotated is None:
        return _without_masks(folder, options)
    if options.instance_property not in (None, OBJECT):
        return replace(ply_scan.read(annotated, options), colors=None)
    cloud = read_ply(annotated)
    if not np.isfinite(cloud.points).all():
        raise ValueError(f"{annotated}: vertices with NaN or infinite coordinates")
    instance = _instances(annotated, cloud)
    labels, empty, remarks = _labels(folder, instance)
    instance, structural = drop_background(instance, labels)
    points, normals, skipped, sensors = cloud.points, cloud.normals, (*structural, *empty), None
    if options.depth_frames:
        found, sensors, lost = depth_points(open_sequence(folder))
        instance = nearest_instance(cloud.points, instance, found)
        points, normals, skipped = found, None, (*skipped, *lost)
    return LabeledCloud(
        points=points,
        instance=None if options.masks else instance,
        normals=normals,
        labels=labels,
        skipped=skipped,
        unit="m",
        warnings=remarks,
        sensors=sensors,
    )


def _first(folder: Path, names: tuple[str, ...]) -> Path | None:
    return next((folder / name for name in names if (folder / name).is_file()), None)


def _instances(path: Path, cloud: PlyCloud) -> Integer[np.ndarray, "n"]:
    if OBJECT not in cloud.integer_properties:
        has = ", ".join(cloud.properties) or "nothing"
        raise ValueError(f"{path}: vertices have {has}; needed a whole number {OBJECT}")
    return instance_ids(path, cloud.properties[OBJECT])


def _labels(
    folder: Path, instance: Integer[np.ndarray, "n"]
) -> tuple[dict[int, str], tuple[Skipped, ...], tuple[str, ...]]:
    """Labels by object, objects without vertices, and a warning where the file is missing."""
    file = _first(folder, LABELS)
    if file is None:
        return {}, (), (f"no {LABELS[0]}: labels are unknown, and walls and floors are told by their shape",)
    labels = {group.id: group.label for group in read_groups(file, segments=False) if group.label}
    present = set(np.unique(instance).tolist())
    empty = (i for i in sorted(labels) if i not in present)
    return labels, tuple(Skipped(what=f"instance {i} ({labels[i]})", reason="no vertices") for i in empty), ()


def _without_masks(folder: Path, options: ReadOptions) -> LabeledCloud:
    """A scan of the hidden test set, or one of which only the raw data were fetched."""
    if options.depth_frames:
        points, sensors, lost = depth_points(open_sequence(folder))
        return LabeledCloud(points=points, instance=None, skipped=lost, unit="m", sensors=sensors)
    mesh = _first(folder, MESHES)
    if mesh is None:
        raise ValueError(f"{folder}: no {ANNOTATED[0]} and no {MESHES[0]}; needed one of them")
    return LabeledCloud(points=read_obj_vertices(mesh), instance=None, unit="m")


def read_obj_vertices(path: Path) -> Float[np.ndarray, "n 3"]:
    """The vertices of an OBJ in the file's order. ValueError, in one line, if a line is no x y z."""
    try:
        with path.open("rb") as file:
            # loadtxt warns of input without rows.
            rows = [line for line in file if line.startswith((b"v ", b"v\t"))]
        return (
            np.loadtxt(rows, np.float64, comments=None, usecols=(1, 2, 3), ndmin=2)
            if rows
            else np.zeros((0, 3))
        )
    except (ValueError, IndexError, OSError) as error:
        raise ValueError(f"{path}: a line 'v' has no x y z ({' '.join(str(error).split())})") from error


def depth_points(
    sequence: Sequence,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "f 3"], tuple[Skipped, ...]]:
    """Back-projected points of evenly spaced frames and the camera's places, in the world; frames left out.

    At most `MOST_FRAMES` frames and about `MOST_POINTS` points: pixels are taken in a fixed stride, so the
    same sequence gives the same points.
    """
    posed: list[tuple[str, np.ndarray]] = []
    lost = 0
    for frame in sequence.frames:
        T_world_camera = read_pose(sequence.load(frame + POSE)) if frame + POSE in sequence.files else None
        if T_world_camera is None:
            lost += 1
        else:
            posed.append((frame, T_world_camera))
    chosen = np.unique(np.linspace(0, len(posed) - 1, min(MOST_FRAMES, len(posed))).round().astype(int))
    parts = [np.zeros((0, 3))]
    for frame, T_world_camera in (posed[i] for i in chosen):
        depth = read_pgm(sequence.load(frame + DEPTH), f"{sequence.where}: {frame}{DEPTH}")
        stride = max(1, int(np.ceil(np.sqrt(depth.size * len(chosen) / MOST_POINTS))))
        parts.append(back_project(depth, sequence.intrinsics, T_world_camera, stride))
    reason = "no pose that is a rigid motion: tracking was lost"
    skipped = (Skipped(what=f"{lost} of {len(sequence.frames)} depth frames", reason=reason),) if lost else ()
    places = np.array([posed[i][1][:3, 3] for i in chosen]).reshape(-1, 3)
    return np.concatenate(parts), places, skipped


def nearest_instance(
    vertices: Float[np.ndarray, "v 3"], instance: Integer[np.ndarray, "v"], points: Float[np.ndarray, "n 3"]
) -> Integer[np.ndarray, "n"]:
    """The instance of the nearest vertex within `NEAREST_M`, else 0."""
    _, nearest = KDTree(vertices).query(points, distance_upper_bound=NEAREST_M, workers=-1)
    return np.append(instance, 0)[nearest]  # the tree answers len(vertices) where nothing is near
