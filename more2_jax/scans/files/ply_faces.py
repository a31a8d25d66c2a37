"""Faces of PLY meshes: triangles, quads, or both; and the normals that they give to the vertices."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Integer
from plyfile import PlyData, PlyListProperty

CORNERS = ("vertex_indices", "vertex_index")

Corners = tuple[Integer[np.ndarray, "c"], Integer[np.ndarray, "c"]]


def face_corners(path: Path, elements: PlyData, vertices: int) -> Corners:
    """The vertex of every corner, the corners of all faces end to end, and the face of each.

    Raises ValueError, in one line, where there are no faces, or a face has a corner that is no vertex.
    """
    if "face" not in elements:
        raise ValueError(f"{path}: no 'face' element; needed a mesh")
    faces = elements["face"]
    name = next((p.name for p in faces.properties if p.name in CORNERS), None)
    if name is None or not isinstance(faces.ply_property(name), PlyListProperty):
        raise ValueError(f"{path}: faces have no list {' or '.join(CORNERS)}; needed their corners")
    lists = faces.data[name]
    if lists.dtype == object:  # mixed: an array a face
        sizes = np.array([len(corners) for corners in lists], np.int64)
        corners = np.concatenate([np.zeros(0, np.int64), *lists])
    else:
        sizes = np.full(len(lists), lists.shape[1], np.int64)
        corners = np.array(lists).ravel()
    if corners.dtype.kind not in "iu":
        raise ValueError(f"{path}: corners of faces are {corners.dtype}; needed whole numbers")
    corners = corners.astype(np.int64)
    if len(corners) and not (corners.min() >= 0 and corners.max() < vertices):
        raise ValueError(f"{path}: a face has a corner outside the {vertices} vertices")
    return corners, np.repeat(np.arange(len(sizes)), sizes)


def vertex_normals(
    points: Float[np.ndarray, "n 3"], corners: Integer[np.ndarray, "c"], face: Integer[np.ndarray, "c"]
) -> Float[np.ndarray, "n 3"]:
    """Unit normals by the winding of the faces around each vertex, weighted by area; 0 where there is none.

    `corners` and `face` as `face_corners` has them. A face is seen counterclockwise from where its normal points.
    """
    normals = np.zeros((len(points), 3))
    if not len(corners):
        return normals
    centered = points - points.mean(axis=0)
    last = np.r_[face[1:] != face[:-1], True]
    first = np.flatnonzero(np.r_[True, last[:-1]])
    following = np.where(
        last, corners[np.repeat(first, np.diff(np.r_[first, len(face)]))], np.roll(corners, -1)
    )
    edge = np.cross(
        centered[corners], centered[following]
    )  # Newell: they sum to twice the area times the normal
    for axis in range(3):
        of_face = np.bincount(face, edge[:, axis])
        normals[:, axis] = np.bincount(corners, of_face[face], minlength=len(points))
    return unit_or_zero(normals)


def unit_or_zero(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """The vectors brought to unit length, float64; 0 where they have none, or are not finite."""
    vectors = np.asarray(vectors, np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.linalg.norm(vectors, axis=1, keepdims=True)
        usable = np.isfinite(length) & (length > 0)
        return np.where(usable, vectors / np.where(usable, length, 1.0), 0.0)
