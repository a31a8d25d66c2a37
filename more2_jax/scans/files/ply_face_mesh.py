"""Meshes in PLY whose faces carry properties: triangles, quads, or both."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Integer

from more2_jax.scans.files.ply_cloud import PlyCloud, cloud_of, read_elements
from more2_jax.scans.files.ply_faces import face_corners


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
    corners, face = face_corners(path, elements, len(cloud.points))
    faces = elements["face"]
    names = [n for n in faces.data.dtype.names or () if faces.data.dtype[n].kind in "iuf"]
    return PlyMesh(
        cloud=cloud,
        corners=corners,
        face=face,
        face_properties={n: np.array(faces.data[n]) for n in names if faces.data.dtype[n].shape == ()},
    )
