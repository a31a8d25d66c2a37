"""ARKitScenes (Baruch et al. 2021): a mesh beside oriented boxes, no masks.

`<id>_3dod_mesh.ply` has the vertices in meters, z up; `<id>_3dod_annotation.json` lists `data[]` with `label` and
`segments.obbAligned`: `centroid`, `axesLengths` (whole lengths) and `normalizedAxes`, nine numbers of which
every three are one axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from more2_jax.scans.files.json_file import read_json
from more2_jax.scans.files.ply_cloud import read_ply
from more2_jax.scans.labeled_cloud import LabeledCloud, ReadOptions
from more2_jax.types import Skipped

MESH, BOXES = "_3dod_mesh.ply", "_3dod_annotation.json"
ORTHONORMAL = 1e-2  # how far the published axes, rounded in the file, may be from a rotation


@dataclass(frozen=True, kw_only=True)
class Box:
    """An oriented box; meters, in the mesh's frame."""

    label: str | None
    center: Float[np.ndarray, "3"]
    lengths: Float[np.ndarray, "3"]  # whole, not half
    axes: Float[np.ndarray, "3 3"]  # rows are the box's axes

    def inside(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Which points lie in the box or on its sides."""
        along = (points - self.center) @ self.axes.T
        return np.asarray((np.abs(along) <= self.lengths / 2).all(axis=1))


def recognizes(path: Path) -> bool:
    """Whether this is such a mesh, its boxes, or a folder with such a mesh."""
    if path.is_dir():
        return any(path.glob(f"*{MESH}"))
    return path.is_file() and path.name.endswith((MESH, BOXES))


def read(path: Path, options: ReadOptions) -> LabeledCloud:
    """Points in a box are its instance, numbered from 1 as in the file; where boxes overlap, of the smaller."""
    mesh = _mesh(path)
    cloud = read_ply(mesh)
    annotation = mesh.with_name(mesh.name.removesuffix(MESH) + BOXES)
    if options.masks or not (options.masks_needed or annotation.is_file()):
        return LabeledCloud(
            points=cloud.points, instance=None, colors=cloud.colors, normals=cloud.normals, unit="m"
        )
    if not annotation.is_file():
        raise ValueError(f"{mesh}: no {annotation.name} beside it; needed its boxes, or masks of your own")
    boxes = read_boxes(annotation)
    instance, skipped = _assign(boxes, cloud.points)
    return LabeledCloud(
        points=cloud.points,
        instance=instance,
        colors=cloud.colors,
        normals=cloud.normals,
        labels={i: box.label for i, box in enumerate(boxes, 1) if box.label},
        skipped=skipped,
        unit="m",
    )


def _mesh(path: Path) -> Path:
    if not path.is_dir():
        mesh = path.with_name(path.name.removesuffix(BOXES) + MESH) if path.name.endswith(BOXES) else path
        if not mesh.is_file():
            raise ValueError(f"{path}: no {mesh.name} beside it; needed the mesh of these boxes")
        return mesh
    meshes = sorted(path.glob(f"*{MESH}"))
    if len(meshes) != 1:
        raise ValueError(f"{path}: {len(meshes)} meshes *{MESH}; needed one (name it)")
    return meshes[0]


def read_boxes(path: Path) -> tuple[Box, ...]:
    """The boxes of an annotation file. ValueError, in one line, on what is missing or malformed."""
    content = read_json(path)
    rows = content.get("data") if isinstance(content, dict) else None
    if not isinstance(rows, list):
        raise ValueError(f"{path}: no list 'data'; needed the boxes of ARKitScenes")
    return tuple(_box(f"{path}: box {i}", row) for i, row in enumerate(rows, 1))


def _box(where: str, row: Any) -> Box:
    try:
        found = row["segments"]["obbAligned"]
        center, lengths = (np.array(found[key], np.float64) for key in ("centroid", "axesLengths"))
        axes = np.array(found["normalizedAxes"], np.float64).reshape(3, 3)
        label = row.get("label")
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, AttributeError) as error:
        raise ValueError(f"{where} has no obbAligned with centroid, axesLengths, normalizedAxes") from error
    if center.shape != (3,) or lengths.shape != (3,):
        raise ValueError(f"{where}: shapes {center.shape}, {lengths.shape}; needed three numbers each")
    if not all(np.isfinite(values).all() for values in (center, lengths, axes)) or lengths.min() < 0:
        raise ValueError(f"{where}: numbers that are not finite, or negative lengths")
    # Bounded first: the product of huge numbers would overflow.
    if np.abs(axes).max() > 2 or np.abs(axes @ axes.T - np.eye(3)).max() > ORTHONORMAL:
        raise ValueError(f"{where}: normalizedAxes are not orthonormal")
    return Box(label=str(label) if label else None, center=center, lengths=lengths, axes=axes)


def _assign(
    boxes: tuple[Box, ...], points: Float[np.ndarray, "n 3"]
) -> tuple[np.ndarray, tuple[Skipped, ...]]:
    """Instances of the points, 0 outside; what boxes are left without points, and why."""
    instance = np.zeros(len(points), np.int64)
    held = np.zeros(len(boxes), np.int64)
    with np.errstate(over="ignore"):
        volumes = [float(np.prod(box.lengths)) for box in boxes]
    for i in sorted(range(len(boxes)), key=lambda i: (-volumes[i], -i)):  # the smallest last: it has its way
        inside = boxes[i].inside(points)
        held[i] = inside.sum()
        instance[inside] = i + 1
    left = np.bincount(instance, minlength=len(boxes) + 1)[1:]
    return instance, tuple(
        Skipped(
            what=f"box {i} ({box.label or 'no label'})",
            reason="all its points lie in smaller boxes" if held[i - 1] else "no points inside",
        )
        for i, box in enumerate(boxes, 1)
        if not left[i - 1]
    )
