"""Replica (Straub et al. 2019): `habitat/mesh_semantic.ply`, whose faces carry the object, and its classes.

Points are the vertices of each object's faces, so a vertex on the border of two objects is a point of both;
vertices without a face are left out. The frame is the mesh's, z up, meters.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from more2_jax.scans.files.json_file import read_json
from more2_jax.scans.files.ply_face_mesh import read_ply_mesh
from more2_jax.scans.labeled_cloud import LabeledCloud, ReadOptions
from more2_jax.scans.segment_groups import shift_of, whole_number
from more2_jax.scans.structural_labels import drop_background
from more2_jax.types import Skipped

MESH, CLASSES = "mesh_semantic.ply", "info_semantic.json"
OBJECT = "object_id"


def recognizes(path: Path) -> bool:
    """Whether this is a scene's folder, its `habitat` folder, or the mesh in it."""
    return any(file.is_file() for file in _candidates(path))


def read(path: Path, options: ReadOptions) -> LabeledCloud:
    """The objects that `info_semantic.json` names; faces of any other id are background.

    Raises ValueError, in one line, when a file is missing or damaged, or faces carry no `object_id`.
    """
    file = next(file for file in _candidates(path) if file.is_file())
    mesh = read_ply_mesh(file)
    if options.masks or not (options.masks_needed or file.with_name(CLASSES).is_file()):
        c = mesh.cloud
        return LabeledCloud(points=c.points, instance=None, colors=c.colors, normals=c.normals, unit="m")
    objects = mesh.face_properties.get(OBJECT)
    if objects is None or objects.dtype.kind not in "iu":
        raise ValueError(f"{file}: faces have no whole number {OBJECT}; needed the object of every face")
    classes = read_classes(file.with_name(CLASSES))
    try:
        shift = shift_of(list(classes))
    except ValueError as error:
        raise ValueError(f"{file.with_name(CLASSES)}: {error}") from error
    vertex, instance = _points_of_objects(mesh.corners, objects.astype(np.int64)[mesh.face], classes, shift)
    labels = {i + shift: name for i, name in classes.items()}
    empty = sorted(set(labels) - set(np.unique(instance).tolist()))
    instance, structural = drop_background(instance, labels)
    colors, normals = mesh.cloud.colors, mesh.cloud.normals
    return LabeledCloud(
        points=mesh.cloud.points[vertex],
        instance=instance,
        colors=None if colors is None else colors[vertex],
        normals=None if normals is None else normals[vertex],
        labels=labels,
        skipped=(
            *structural,
            *(Skipped(what=f"instance {i} ({labels[i]})", reason="no faces") for i in empty),
        ),
        unit="m",
        warnings=(f"{CLASSES} counts objects from 0: instance i is object i - 1",) if shift else (),
    )


def read_classes(path: Path) -> dict[int, str]:
    """Class name by object id. ValueError, in one line, on what is missing or malformed."""
    if not path.is_file():
        raise ValueError(f"{path}: no such file; needed the classes of the objects")
    content = read_json(path)
    rows = content.get("objects") if isinstance(content, dict) else None
    if not isinstance(rows, list):
        raise ValueError(f"{path}: no list 'objects'; needed id and class_name of each")
    classes: dict[int, str] = {}
    for i, row in enumerate(rows):
        name = row.get("class_name") if isinstance(row, dict) else None
        if not isinstance(name, str):
            raise ValueError(f"{path}: objects[{i}] has no class_name; needed id and class_name of each")
        classes[whole_number(row.get("id"), f"{path}: objects[{i}].id")] = name
    return classes


def _points_of_objects(
    corners: np.ndarray, objects: np.ndarray, classes: dict[int, str], shift: int
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and instances of the points: each vertex once for every instance whose faces touch it."""
    instance = np.where(np.isin(objects, list(classes)), objects + shift, 0)
    count = corners.max(initial=0) + 1
    pairs = np.unique(
        instance * count + corners
    )  # fits: instances have 31 bits, vertices fewer than a file's bytes
    return pairs % count, pairs // count


def _candidates(path: Path) -> tuple[Path, ...]:
    if path.name == MESH:
        return (path,)
    return (path / "habitat" / MESH, path / MESH)
