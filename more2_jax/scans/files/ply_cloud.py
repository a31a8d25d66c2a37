"""PLY point clouds: ascii or binary, either byte order, float or double."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Integer
from plyfile import PlyData, PlyParseError

from more2_jax.scans.files.ply_faces import CORNERS, face_corners, unit_or_zero, vertex_normals
from more2_jax.scans.labeled_cloud import one_line

COLOR_PROPERTIES = ("red", "green", "blue")
NORMAL_PROPERTIES = ("nx", "ny", "nz")


@dataclass(frozen=True, kw_only=True)
class PlyCloud:
    """The vertices of a PLY file: coordinates in the file's unit, and every other scalar property by name."""

    points: Float[np.ndarray, "n 3"]  # float64
    properties: dict[str, np.ndarray]  # name → (n,)
    normals: Float[np.ndarray, "n 3"] | None = (
        None  # unit, outward; 0: not known. None: the file says nothing
    )

    @property
    def integer_properties(self) -> list[str]:
        """Names of the properties that could name an instance: integers that are not colors."""
        return [k for k, v in self.properties.items() if v.dtype.kind in "iu" and k not in COLOR_PROPERTIES]

    @property
    def colors(self) -> Integer[np.ndarray, "n 3"] | None:
        """Red, green, blue as uint8; None where the file has none. Float colors are taken as shares of 1."""
        if not all(c in self.properties for c in COLOR_PROPERTIES):
            return None
        rgb = np.stack([self.properties[c] for c in COLOR_PROPERTIES], axis=-1)
        return np.clip(rgb * 255.0 if rgb.dtype.kind == "f" else rgb, 0, 255).astype(np.uint8)


def read_ply(path: Path) -> PlyCloud:
    """Reads the vertices of a PLY file.

    Raises ValueError, in one line, when the file is not a PLY, is truncated, or its vertices lack x, y or z.
    """
    return cloud_of(path, read_elements(path))


def cloud_of(path: Path, elements: PlyData) -> PlyCloud:
    """The vertices among the elements of a file. ValueError, in one line, if they lack x, y or z."""
    if "vertex" not in elements:
        raise ValueError(f"{path}: no 'vertex' element; needed a PLY of points")
    vertices = elements["vertex"].data
    names = vertices.dtype.names or ()
    if missing := [axis for axis in "xyz" if axis not in names]:
        raise ValueError(
            f"{path}: vertices have {', '.join(names) or 'nothing'}; needed {', '.join(missing)} too"
        )
    # Copies: the elements may be a map of the file.
    scalars = {name: np.array(vertices[name]) for name in names if vertices.dtype[name].kind in "iuf"}
    if missing := [axis for axis in "xyz" if axis not in scalars]:
        raise ValueError(f"{path}: {', '.join(missing)} of the vertices are lists; needed numbers")
    with np.errstate(invalid="ignore"):  # a signaling NaN: refused where coordinates are checked
        points = np.stack([scalars.pop(axis).astype(np.float64) for axis in "xyz"], axis=-1)
    return PlyCloud(points=points, properties=scalars, normals=_normals(path, elements, points, scalars))


def _normals(
    path: Path, elements: PlyData, points: Float[np.ndarray, "n 3"], scalars: dict[str, np.ndarray]
) -> Float[np.ndarray, "n 3"] | None:
    """The vertices' own where the file has them, else those of its faces; damaged faces have nothing to say."""
    if all(n in scalars for n in NORMAL_PROPERTIES):
        return unit_or_zero(np.stack([scalars[n] for n in NORMAL_PROPERTIES], axis=-1))
    if "face" not in elements or not np.isfinite(points).all():
        return None
    try:
        corners, face = face_corners(path, elements, len(points))
    except ValueError:
        return None
    return vertex_normals(points, corners, face) if len(corners) else None


def read_elements(path: Path) -> PlyData:
    """All elements of a PLY file. ValueError, in one line, when it is no PLY, is truncated or damaged.

    Faces of equally many corners are mapped at once; those of mixed meshes are read list by list, which is slow.
    """
    try:
        with path.open("rb") as file:
            first = file.readline(16).strip()
    except OSError as error:
        raise ValueError(f"{path}: not readable ({one_line(error)})") from error
    if first != b"ply":
        raise ValueError(f"{path}: not a PLY file; needed one that begins with the line 'ply'")
    reason: Exception = ValueError("no reason")
    for corners in (3, 4, None):
        known = {} if corners is None else {"face": dict.fromkeys(CORNERS, corners)}
        try:
            with warnings.catch_warnings(
                action="ignore", category=UserWarning
            ):  # NumPy's, of faces cut short
                return PlyData.read(str(path), known_list_len=known)
        except (PlyParseError, ValueError, TypeError, EOFError, OverflowError, MemoryError, OSError) as error:
            reason = error
    raise ValueError(
        f"{path}: truncated or damaged PLY ({one_line(reason)}); needed a complete file"
    ) from reason
