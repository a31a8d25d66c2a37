"""Meshes and accumulated clouds as binary PLY, in double precision: a kilometer away costs no micrometer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from plyfile import PlyData, PlyElement

from more2_jax.scans.files.ply_cloud import cloud_of, read_elements, read_ply
from more2_jax.scans.files.ply_faces import face_corners
from more2_jax.types import Mesh

NORMAL = ("nx", "ny", "nz")


def _vertices(points: Float[np.ndarray, "n 3"], **properties: np.ndarray) -> PlyElement:
    columns = {axis: np.asarray(points, "<f8")[:, i] for i, axis in enumerate("xyz")} | properties
    table = np.empty(len(points), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        table[name] = column
    return PlyElement.describe(table, "vertex")


def write_points(
    path: Path,
    points: Float[np.ndarray, "n 3"],
    scan: Int[np.ndarray, " n"],
    name: str = "scan",
    normals: Float[np.ndarray, "n 3"] | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Writes a cloud in meters, with its normals if it has any; each point's integer is the vertex property `name`.

    `comments` are lines of the header, in ASCII.
    """
    columns = {name: np.asarray(scan, "<i4")}
    if normals is not None:
        columns |= {axis: np.asarray(normals, "<f8")[:, i] for i, axis in enumerate(NORMAL)}
    PlyData([_vertices(points, **columns)], byte_order="<", comments=list(comments)).write(str(path))


def read_points(
    path: Path,
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"], Float[np.ndarray, "n 3"] | None]:
    """Reads a cloud, the scan of each of its points, and their normals as written, if there are any.

    Raises ValueError if the file is damaged.
    """
    cloud = read_ply(path)
    if "scan" not in cloud.integer_properties:
        raise ValueError(f"{path}: no integer vertex property scan")
    normals = None
    if all(axis in cloud.properties for axis in NORMAL):
        normals = np.stack([np.asarray(cloud.properties[axis], np.float64) for axis in NORMAL], axis=-1)
    return cloud.points, cloud.properties["scan"].astype(np.int32), normals


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Writes a triangle mesh in meters."""
    faces = np.empty(len(mesh.faces), [("vertex_indices", "<i4", (3,))])
    faces["vertex_indices"] = mesh.faces
    PlyData([_vertices(mesh.vertices), PlyElement.describe(faces, "face")], byte_order="<").write(str(path))


def read_mesh(path: Path) -> Mesh:
    """Reads a triangle mesh. Raises ValueError if the file is damaged or has other polygons."""
    elements = read_elements(path)
    vertices = cloud_of(path, elements).points
    corners, face = face_corners(path, elements, len(vertices))
    if len(corners) % 3 or (face != np.arange(len(corners)) // 3).any():
        raise ValueError(f"{path}: faces of other than three corners; needed triangles")
    return Mesh(vertices=vertices, faces=corners.astype(np.int32).reshape(-1, 3))
