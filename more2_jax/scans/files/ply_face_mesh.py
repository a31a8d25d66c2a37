"""Meshes in PLY whose faces carry properties: triangles, quads, or both."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Integer
from plyfile import PlyListProperty

from more2_jax.scans.files.ply_cloud import CORNERS, PlyCloud, cloud_of, read_elements


@dataclass(frozen=True, kw_only=True)
class PlyMesh:
    """Vertices, and the corners of all faces end to end."""

    cloud: PlyCloud
    corners: Integer[np.ndarray, "c"]  # vertex of each corner
    face: Integer[np.ndarray, "c"]  # face of each corner
    face_properties: dict[str, np.ndarray]  # scalar properties: name → (faces,)


def read_ply_mesh(path: Path) -> PlyMesh:
    """Reads vertices and faces.

    Raises ValueError, in one line, when the file is no PLY, is damaged, has no faces, or a face has a corner
    that is no vertex.
    """
    elements = read_elements(path)
    cloud = cloud_of(path, elements)
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
    if len(corners) and not (corners.min() >= 0 and corners.max() < len(cloud.points)):
        raise ValueError(f"{path}: a face has a corner outside the {len(cloud.points)} vertices")
    names = [n for n in faces.data.dtype.names or () if faces.data.dtype[n].kind in "iuf"]
    return PlyMesh(
        cloud=cloud,
        corners=corners,
        face=np.repeat(np.arange(len(sizes)), sizes),
        face_properties={n: np.array(faces.data[n]) for n in names if faces.data.dtype[n].shape == ()},
    )
