"""Furniture of SweetHome3D catalogs (.sh3f): meshes in meters, z up, with license and maker."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int

from train.furniture.mesh_files import UNREADABLE, Report, attempt
from train.furniture.source_mesh import SourceMesh

# Catalog frames have y up; ours z up.
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@dataclass(frozen=True, kw_only=True)
class Furniture:
    """One piece: meters, z up, standing on z = 0 with the middle of its footprint at the origin."""

    id: int
    name: str
    creator: str
    license: str
    category: str  # the catalog's own, such as "Living room"
    tags: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


# Word of a piece's name or tags → kind, the first that is found.
KINDS = {
    "lamp": "lamp",
    "light": "lamp",
    "armchair": "armchair",
    "office chair": "office chair",
    "stool": "stool",
    "bench": "bench",
    "sofa": "sofa",
    "couch": "sofa",
    "chair": "chair",
    "bookcase": "shelf",
    "shel": "shelf",
    "nightstand": "cabinet",
    "bedside": "cabinet",
    "cabinet": "cabinet",
    "wardrobe": "cabinet",
    "dresser": "cabinet",
    "trash": "trash can",
    "dustbin": "trash can",
    "waste": "trash can",
    "desk": "desk",
    "table": "table",
    "pillow": "pillow",
    "cushion": "pillow",
    "bed": "bed",
}
NOT_FURNITURE = ("Characters", "Vehicles", "Staircases", "Doors and windows")


def read_furniture(path: str | Path, report: Report | None = None) -> Iterator[SourceMesh]:
    """The furniture of a catalog, its kind told by name and tags, with license and maker.

    What is no furniture, or cannot be read, goes to `report`; without one the latter raises ValueError.
    """
    path = Path(path)
    archive, properties, numbers = _open(path)
    for number in numbers:
        name = f"{path.stem}_{number:03d}"
        category = properties.get(f"category#{number}", "").strip()
        if category in NOT_FURNITURE:
            if report is not None:
                report(name, f"catalog category {category!r}; needed furniture")
            continue
        yield from attempt(lambda: _as_source(archive, properties, number, name, path.name), name, report)  # noqa: B023


def _as_source(
    archive: zipfile.ZipFile, properties: dict[str, str], number: int, name: str, source: str
) -> SourceMesh:
    try:
        piece = _piece(archive, properties, number)
    except UNREADABLE as error:
        raise ValueError(f"{source}: piece {number}: not readable ({error})") from error
    license = f"{piece.license or 'unknown'}; {piece.name} by {piece.creator or 'unknown'}"
    kind = kind_of(f"{piece.name} {piece.tags}") or piece.category.lower() or "object"
    return SourceMesh(
        name=name, category=kind, vertices=piece.vertices, faces=piece.faces, source=source, license=license
    )


def kind_of(words: str) -> str | None:
    """The kind of furniture that a name and tags speak of, or None."""
    return next((kind for word, kind in KINDS.items() if word in words.lower()), None)


def read_catalog(path: str | Path, ids: tuple[int, ...] | None = None) -> Iterator[Furniture]:
    """The pieces of a catalog, or those with `ids`. Raises ValueError if it is not a catalog."""
    archive, properties, numbers = _open(Path(path))
    for number in numbers:
        if ids is None or number in ids:
            yield _piece(archive, properties, number)


def _open(path: Path) -> tuple[zipfile.ZipFile, dict[str, str], list[int]]:
    """The catalog's archive, its properties and the numbers of its pieces."""
    try:
        archive = zipfile.ZipFile(path)
        text = archive.read("PluginFurnitureCatalog.properties").decode("latin-1")
    except (OSError, KeyError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: not a SweetHome3D catalog ({error}); needed a .sh3f file") from error
    properties = dict(line.split("=", 1) for line in text.splitlines() if "=" in line and line[0] != "#")
    numbers = sorted(int(k.split("#")[1]) for k in properties if k.startswith("model#"))
    return archive, properties, numbers


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
        license=properties.get("license", "").strip(),
        category=get("category"),
        tags=get("tags"),
        vertices=vertices,
        faces=np.asarray(mesh.faces, np.int64),
    )
