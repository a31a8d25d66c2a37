"""ScanNet++ (Yeshwanth et al. 2023): `scans/mesh_aligned_0.05.ply`, `segments.json`, `segments_anno.json`.

Points are in the frame of the aligned mesh, z up, meters.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from more2_jax.scans.files.ply_cloud import read_ply
from more2_jax.scans.labeled_cloud import LabeledCloud, ReadOptions
from more2_jax.scans.segment_groups import labeled_by_groups, read_groups, read_segment_indices, shift_of

MESH, SEGMENTS, ANNOTATION = "mesh_aligned_0.05.ply", "segments.json", "segments_anno.json"


def recognizes(path: Path) -> bool:
    """Whether this is a scene's folder, its `scans` folder, or the mesh in it."""
    return any(file.is_file() for file in _candidates(path))


def read(path: Path, options: ReadOptions) -> LabeledCloud:
    """The vertices by annotated object, with its id (one more where the file counts from 0, and a warning).

    Raises ValueError, in one line, when a file of the scene is missing, damaged or does not fit the mesh.
    """
    mesh = next(file for file in _candidates(path) if file.is_file())
    cloud = read_ply(mesh)
    if options.masks or not (options.masks_needed or mesh.with_name(ANNOTATION).is_file()):
        return LabeledCloud(
            points=cloud.points, instance=None, colors=cloud.colors, normals=cloud.normals, unit="m"
        )
    for name in (SEGMENTS, ANNOTATION):
        if not mesh.with_name(name).is_file():
            raise ValueError(f"{mesh}: no {name} beside it; needed the annotation, or masks of your own")
    annotation = mesh.with_name(ANNOTATION)
    groups = read_groups(annotation)
    indices = read_segment_indices(mesh.with_name(SEGMENTS), len(cloud.points))
    try:
        shift = shift_of([group.id for group in groups])
    except ValueError as error:
        raise ValueError(f"{annotation}: {error}") from error
    said = (f"{ANNOTATION} counts objects from 0: instance i is object i - 1",) if shift else ()
    return replace(labeled_by_groups(cloud, groups, indices, shift), warnings=said)


def _candidates(path: Path) -> tuple[Path, ...]:
    if path.name == MESH:
        return (path,)
    return (path / MESH, path / "scans" / MESH)
