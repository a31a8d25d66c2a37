"""Meshes as apps and modelers export them: OBJ, glTF (GLB), STL, OFF. Points lie evenly on the faces.

A file of several named meshes holds an object each, unless the scan is to be cut otherwise (`--segment`). Of glTF y is
up and meters are the unit, by its standard; the others are taken as they are.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Integer
from trimesh.visual.color import ColorVisuals

from more2_jax.geometry.up_axis import R_UP
from more2_jax.scans.labeled_cloud import LabeledCloud, ReadOptions, one_line
from more2_jax.scans.large_instances import MOST_POINTS
from more2_jax.scans.structural_labels import drop_background, is_background

GLTF, OTHERS = (".glb", ".gltf"), (".obj", ".stl", ".off")
SPACING = 1 / 150  # of points, as a share of the diagonal of a mesh; and as many as it has vertices, at least
MOST_OF_A_ROOM = 2_000_000  # points
NUMBER = re.compile(r"[\s._-]*\d+$")  # after a name
AS_OBJECTS = "every mesh of the file is taken as an object; --segment cuts the whole instead"


def recognizes(path: Path) -> bool:
    """Whether this is such a file, by its suffix."""
    return path.is_file() and path.suffix.lower() in (*GLTF, *OTHERS)


def read(path: Path, options: ReadOptions) -> LabeledCloud:
    """Points on the faces; ids count from 1 in the order of the names.

    Raises ValueError, in one line, for no faces, and for masks, which speak of the rows of a cloud.
    """
    if options.masks is not None:
        raise ValueError(f"{path}: masks speak of a file's points, and a mesh's are drawn anew; needed a PLY")
    meshes = _meshes(path)
    as_objects = len(meshes) > 1 and options.masks_needed
    rooms = [not as_objects or is_background(name) for name, _ in meshes]
    most = [MOST_OF_A_ROOM if room else MOST_POINTS for room in rooms]
    sampled = [_sampled(mesh, n) for (_, mesh), n in zip(meshes, most, strict=True)]
    normals = [mesh.face_normals[face] for (_, mesh), (_, face) in zip(meshes, sampled, strict=True)]
    R = (
        R_UP["y"] if path.suffix.lower() in GLTF and options.up != "y" else np.eye(3)
    )  # `--up y` turns it itself
    count, instance, labels, skipped = [len(p) for p, _ in sampled], None, {}, ()
    if as_objects:
        labels = {k: name for k, (name, _) in enumerate(meshes, start=1)}
        instance, skipped = drop_background(np.repeat(np.arange(len(meshes)) + 1, count), labels)
    return LabeledCloud(
        points=np.concatenate([p for p, _ in sampled]) @ R.T,
        instance=instance,
        colors=_colors([mesh for _, mesh in meshes], [face for _, face in sampled]),
        normals=np.concatenate(normals) @ R.T,
        labels=labels,
        skipped=skipped,
        unit="m" if path.suffix.lower() in GLTF else None,
        warnings=() if instance is None else (AS_OBJECTS,),
    )


def _meshes(path: Path) -> list[tuple[str, trimesh.Trimesh]]:
    """Names and meshes with faces, where they stand in the file. `Wall_3` and `wall.003` are each a wall."""
    told: dict[str, Any] = {"split_objects": True, "group_material": False, "skip_materials": True}
    try:
        scene = trimesh.load_scene(path, process=False, **(told if path.suffix.lower() == ".obj" else {}))
        found = []
        for node in sorted(scene.graph.nodes_geometry):
            T, name = scene.graph[node]
            mesh = scene.geometry[name]
            if isinstance(mesh, trimesh.Trimesh) and mesh.area > 0:  # NaN is not
                found.append((NUMBER.sub("", str(node)) or str(node), mesh.copy().apply_transform(T)))
    except Exception as error:  # readers of damaged files raise whatever they stumble over
        raise ValueError(f"{path}: not a readable mesh ({one_line(error)})") from error
    if not found:
        raise ValueError(f"{path}: no faces with an area; needed a mesh")
    if not all(np.isfinite(mesh.vertices).all() and np.isfinite(mesh.area) for _, mesh in found):
        raise ValueError(f"{path}: vertices that are not finite, or too far apart; needed meters, cm or mm")
    return found


def _sampled(mesh: trimesh.Trimesh, most: int) -> tuple[Float[np.ndarray, "n 3"], Integer[np.ndarray, " n"]]:
    """Points on the faces, the same ones every time, and the face of each."""
    needed = mesh.area / (SPACING * mesh.scale) ** 2
    count = int(min(max(needed, len(mesh.vertices)), most))
    sampled = trimesh.sample.sample_surface(mesh, count, seed=0)
    return np.asarray(sampled[0], np.float64), np.asarray(sampled[1])


def _colors(
    meshes: Sequence[trimesh.Trimesh], faces: Sequence[Integer[np.ndarray, "_"]]
) -> Integer[np.ndarray, "n 3"] | None:
    """Of the faces; None unless all meshes have colors. Textures are not read."""
    found = []
    for mesh, face in zip(meshes, faces, strict=True):
        if not isinstance(mesh.visual, ColorVisuals) or mesh.visual.kind is None:
            return None
        found.append(np.asarray(mesh.visual.face_colors)[face, :3])
    return np.concatenate(found).astype(np.uint8)
