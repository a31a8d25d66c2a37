"""Meshes in PLY whose faces carry properties: triangles, quads, or both."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from more2_jax.data.ply import PlyCloud, read_ply

CORNERS = ("vertex_indices", "vertex_index")


@dataclass(frozen=True, kw_only=True)
class PlyMesh:
    """Vertices, and the corners of all faces end to end."""

    cloud: PlyCloud
    corners: Int[np.ndarray, "c"]  # vertex of each corner
    face: Int[np.ndarray, "c"]  # face of each corner
    face_properties: dict[str, np.ndarray]  # scalar properties: name → (faces,)


def read_ply_mesh(path: Path) -> PlyMesh:
    """Reads vertices and faces.

    Raises ValueError, in one line, when the file is no PLY, is damaged, has no faces, or a face has a corner
    that is no vertex.
    """
    cloud = read_ply(path)
    faces = _faces(path)
    name = next((p.name for p in faces.properties if p.name in CORNERS), None)
    if name is None or not isinstance(faces.ply_property(name), PlyListProperty):
        raise ValueError(f"{path}: faces have no list {' or '.join(CORNERS)}; needed their corners")
    lists = faces.data[name]
    sizes = np.array([len(corners) for corners in lists], np.int64)
    corners = np.concatenate([np.zeros(0, np.int64), *lists]) if lists.dtype == object else lists.ravel()
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


def _faces(path: Path) -> PlyElement:
    """Faces of equally many corners are read at once; only mixed ones list by list, which is slow."""
    reason: Exception | None = None
    for corners in (4, 3, None):
        known = {} if corners is None else {"face": dict.fromkeys(CORNERS, corners)}
        try:
            elements = PlyData.read(str(path), mmap=corners is not None, known_list_len=known)  # pyright: ignore[reportArgumentType]
        except (PlyParseError, ValueError, EOFError, OverflowError, MemoryError, OSError) as error:
            reason = error
            continue
        if "face" not in elements:
            raise ValueError(f"{path}: no 'face' element; needed a mesh")
        return elements["face"]
    what = " ".join(str(reason).split()) or type(reason).__name__
    raise ValueError(f"{path}: truncated or damaged PLY ({what}); needed a complete file") from reason
