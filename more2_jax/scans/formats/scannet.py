"""ScanNet (Dai et al. 2017): `<scene>_vh_clean_2.ply` with its segments and their aggregation beside it.

`objectId` counts from 0, so instance i here is object i - 1 there. Points are in the mesh's own frame, z up;
the benchmark's `axisAlignment` is not applied.
"""

from __future__ import annotations

from pathlib import Path

from more2_jax.scans.files.ply_cloud import read_ply
from more2_jax.scans.formats import ply_scan
from more2_jax.scans.labeled_cloud import LabeledCloud, ReadOptions
from more2_jax.scans.segment_groups import labeled_by_groups, read_groups, read_segment_indices

MESH = "_vh_clean_2.ply"
SEGMENTS = "_vh_clean_2.0.010000.segs.json"
AGGREGATIONS = (".aggregation.json", "_vh_clean_2.aggregation.json")
SHIFT = 1  # 0 is the first object there, background here


def recognizes(path: Path) -> bool:
    """Whether this is such a mesh, or a folder with one."""
    if path.is_dir():
        return any(path.glob(f"*{MESH}"))
    return path.is_file() and path.name.endswith(MESH)


def read(path: Path, options: ReadOptions) -> LabeledCloud:
    """The vertices, each in the instance that its segment belongs to; walls, floors and the like are background.

    Raises ValueError, in one line, when a file of the scene is missing, damaged or does not fit the mesh.
    """
    mesh = _mesh(path)
    if options.instance_property is not None:
        return ply_scan.read(mesh, options)
    cloud = read_ply(mesh)
    if options.masks or not (options.masks_needed or _annotated(mesh)):
        return LabeledCloud(
            points=cloud.points, instance=None, colors=cloud.colors, normals=cloud.normals, unit="m"
        )
    groups = read_groups(_beside(mesh, *AGGREGATIONS))
    if any(group.id < 0 for group in groups):
        raise ValueError(f"{_beside(mesh, *AGGREGATIONS)}: a negative objectId; needed 0 or more")
    indices = read_segment_indices(_beside(mesh, SEGMENTS), len(cloud.points))
    return labeled_by_groups(cloud, groups, indices, SHIFT)


def _annotated(mesh: Path) -> bool:
    """Whether the scene has its annotation; those of the hidden test set have none."""
    return any(mesh.with_name(mesh.name.removesuffix(MESH) + ending).is_file() for ending in AGGREGATIONS)


def _mesh(path: Path) -> Path:
    if not path.is_dir():
        return path
    meshes = sorted(path.glob(f"*{MESH}"))
    if len(meshes) != 1:
        raise ValueError(f"{path}: {len(meshes)} meshes *{MESH}; needed one (name it)")
    return meshes[0]


def _beside(mesh: Path, *endings: str) -> Path:
    """The file of the scene with the first of these endings that is there."""
    scene = mesh.name.removesuffix(MESH)
    found = [mesh.with_name(scene + ending) for ending in endings]
    for file in found:
        if file.is_file():
            return file
    raise ValueError(f"{mesh}: no {found[0].name} beside it; needed the annotation, or masks of your own")
