"""Furniture of SweetHome3D catalogues (.sh3f): meshes in metres, z up, with licence and maker."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int

# Catalogue frames have y up; ours z up.
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@dataclass(frozen=True, kw_only=True)
class Furniture:
    """One piece: metres, z up, standing on z = 0 with the middle of its footprint at the origin."""

    id: int
    name: str
    creator: str
    licence: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


def read_catalogue(path: str | Path, ids: tuple[int, ...] | None = None) -> Iterator[Furniture]:
    """The pieces of a catalogue, or those with `ids`. Raises ValueError if it is not a catalogue."""
    try:
        archive = zipfile.ZipFile(path)
        text = archive.read("PluginFurnitureCatalog.properties").decode("latin-1")
    except (OSError, KeyError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: not a SweetHome3D catalogue ({error}); needed a .sh3f file") from error
    properties = dict(line.split("=", 1) for line in text.splitlines() if "=" in line and line[0] != "#")
    numbers = sorted(int(k.split("#")[1]) for k in properties if k.startswith("model#"))
    for number in numbers:
        if ids is None or number in ids:
            yield _piece(archive, properties, number)


def _piece(archive: zipfile.ZipFile, properties: dict[str, str], number: int) -> Furniture:
    def get(key: str) -> str:
        return properties.get(f"{key}#{number}", "").strip()

    data = archive.read(get("model").lstrip("/"))
    mesh = trimesh.load_mesh(io.BytesIO(data), file_type=Path(get("model")).suffix[1:], process=False)
    vertices = np.asarray(mesh.vertices, np.float64)
    if rotation := get("modelRotation"):
        vertices = vertices @ np.array(rotation.split(), np.float64).reshape(3, 3).T
    size_m = np.array([float(get(k)) for k in ("width", "height", "depth")]) / 100
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    vertices = (vertices - (low + high) / 2) / np.maximum(high - low, 1e-9) * size_m
    vertices = vertices @ Z_UP.T
    vertices[:, 2] -= vertices[:, 2].min()
    return Furniture(
        id=number,
        name=get("name"),
        creator=get("creator"),
        licence=properties.get("license", "").strip(),
        vertices=vertices,
        faces=np.asarray(mesh.faces, np.int64),
    )
