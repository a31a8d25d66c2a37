"""PLY point clouds: ascii or binary, either byte order, float or double."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from plyfile import PlyData, PlyParseError

INSTANCE_PROPERTIES = ("instance", "instance_id", "objectId", "object_id", "label")
COLOR_PROPERTIES = ("red", "green", "blue")


@dataclass(frozen=True, kw_only=True)
class PlyCloud:
    """The vertices of a PLY file: coordinates in the file's unit, and every other scalar property by name."""

    points: Float[np.ndarray, "n 3"]  # float64
    properties: dict[str, np.ndarray]  # name → (n,)

    @property
    def integer_properties(self) -> list[str]:
        """Names of the properties that could name an instance: integers that are not colours."""
        return [k for k, v in self.properties.items() if v.dtype.kind in "iu" and k not in COLOR_PROPERTIES]

    @property
    def colors(self) -> Int[np.ndarray, "n 3"] | None:
        """Red, green, blue as uint8; None where the file has none. Float colours are taken as shares of 1."""
        if not all(c in self.properties for c in COLOR_PROPERTIES):
            return None
        rgb = np.stack([self.properties[c] for c in COLOR_PROPERTIES], axis=-1)
        return np.clip(rgb * 255.0 if rgb.dtype.kind == "f" else rgb, 0, 255).astype(np.uint8)


def read_ply(path: Path) -> PlyCloud:
    """Reads the vertices of a PLY file.

    Raises ValueError, in one line, when the file is not a PLY, is truncated, or its vertices lack x, y or z.
    """
    with path.open("rb") as file:
        if file.readline(16).strip() != b"ply":
            raise ValueError(f"{path}: not a PLY file; needed one that begins with the line 'ply'")
    vertices = _vertices(path)
    names = vertices.dtype.names or ()
    if missing := [axis for axis in "xyz" if axis not in names]:
        raise ValueError(
            f"{path}: vertices have {', '.join(names) or 'nothing'}; needed {', '.join(missing)} too"
        )
    scalars = {name: vertices[name] for name in names if vertices.dtype[name].kind in "iuf"}
    points = np.stack([np.asarray(scalars.pop(axis), np.float64) for axis in "xyz"], axis=-1)
    return PlyCloud(points=points, properties=scalars)


def _vertices(path: Path) -> np.ndarray:
    try:
        elements = PlyData.read(str(path), mmap=False)  # pyright: ignore[reportArgumentType]
    except (PlyParseError, ValueError, UnicodeDecodeError, EOFError, OverflowError, MemoryError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{path}: truncated or damaged PLY ({reason}); needed a complete file") from error
    if "vertex" not in elements:
        raise ValueError(f"{path}: no 'vertex' element; needed a PLY of points")
    return elements["vertex"].data
