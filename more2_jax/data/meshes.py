"""Source meshes: packed collections (.npz) and folders of mesh files."""

from __future__ import annotations

import hashlib
import struct
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int

MESH_SUFFIXES = (".obj", ".glb", ".off", ".ply", ".stl")
LEVELS = 65535.0  # of a packed coordinate


@dataclass(frozen=True, kw_only=True)
class SourceMesh:
    """One mesh of a collection, as it came: any unit, rarely watertight."""

    name: str
    category: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    source: str

    @property
    def digest(self) -> int:
        """A number that depends on the name alone: orders and splits collections the same way everywhere."""
        return name_digest(self.name)


def read_meshes(path: str | Path) -> Iterator[SourceMesh]:
    """The meshes of a packed .npz, or of a folder (one category a sub-folder).

    Raises ValueError if it is neither, or if the .npz is damaged or lacks an array.
    """
    path = Path(path)
    if path.is_dir():
        yield from _read_folder(path)
    elif path.suffix == ".npz" and path.is_file():
        yield from _read_packed(path)
    else:
        raise ValueError(f"{path}: needed a packed .npz or a folder of {', '.join(MESH_SUFFIXES)}")


def write_packed(path: str | Path, meshes: Sequence[SourceMesh]) -> None:
    """Packs meshes into one .npz, 16 bits a coordinate of its mesh's box. ValueError if there is none."""
    if not meshes:
        raise ValueError("no meshes to pack; needed at least one")
    low = np.array([m.vertices.min(axis=0) for m in meshes])
    high = np.array([m.vertices.max(axis=0) for m in meshes])
    steps = [
        np.round((m.vertices - lo) / np.maximum(hi - lo, 1e-12) * LEVELS).astype(np.uint16)
        for m, lo, hi in zip(meshes, low, high, strict=True)
    ]
    most = max(len(m.vertices) for m in meshes)
    np.savez_compressed(
        path,
        vertices=np.concatenate(steps),
        faces=np.concatenate([m.faces for m in meshes]).astype(np.uint16 if most < 2**16 else np.uint32),
        names=np.array([m.name for m in meshes]),
        categories=np.array([m.category for m in meshes]),
        lo=low,
        hi=high,
        n_vertices=np.array([len(m.vertices) for m in meshes]),
        n_faces=np.array([len(m.faces) for m in meshes]),
    )


def _read_packed(path: Path) -> Iterator[SourceMesh]:
    try:
        with np.load(path, allow_pickle=False) as packed:
            arrays = {name: packed[name] for name in packed.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: not a readable .npz ({error}); needed packed meshes") from error
    needed = {"vertices", "faces", "names", "n_vertices", "n_faces", "lo", "hi"}
    if missing := sorted(needed - set(arrays)):
        raise ValueError(f"{path}: packed meshes lack {', '.join(missing)}")
    vertices = np.split(arrays["vertices"], np.cumsum(arrays["n_vertices"])[:-1])
    faces = np.split(arrays["faces"], np.cumsum(arrays["n_faces"])[:-1])
    # A collection without categories is of one, which its file is named after.
    categories = arrays.get("categories", [path.stem.removeprefix("infinigen_")] * len(vertices))
    rows = zip(arrays["names"], categories, vertices, faces, arrays["lo"], arrays["hi"], strict=True)
    for name, category, v, f, lo, hi in rows:
        yield SourceMesh(
            name=str(name),
            category=str(category),
            vertices=_in_metres(str(name), lo + v / LEVELS * (hi - lo)),
            faces=f.astype(np.int64),
            source=path.name,
        )


def _in_metres(name: str, vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
    """Infinigen's trash cans alone are not metric: the name decides on a height of 0.25 to 0.7 m."""
    if not name.startswith("TrashFactory"):
        return vertices
    share = name_digest(name) % 1000 / 999
    return vertices * ((0.25 + 0.45 * share) / np.ptp(vertices[:, 2]))


def name_digest(name: str) -> int:
    """A large number that depends on the name alone, the same on every machine."""
    return int(hashlib.sha1(name.encode()).hexdigest(), 16)


def _read_folder(path: Path) -> Iterator[SourceMesh]:
    for file in sorted(p for p in path.rglob("*") if p.suffix.lower() in MESH_SUFFIXES):
        try:
            mesh = trimesh.load_mesh(file)
        except (ValueError, IndexError, KeyError, OSError, struct.error) as error:
            raise ValueError(f"{file}: not a readable mesh ({error})") from error
        yield SourceMesh(
            name=str(file.relative_to(path)),
            category=file.parent.name if file.parent != path else "object",
            vertices=np.asarray(mesh.vertices, np.float64),
            faces=np.asarray(mesh.faces, np.int64),
            source=path.name,
        )


def check_mesh(mesh: SourceMesh) -> None:
    """Raises ValueError if the mesh has no surface, or its faces name vertices that do not exist."""
    if not len(mesh.vertices) or not len(mesh.faces):
        raise ValueError(f"{len(mesh.vertices)} vertices, {len(mesh.faces)} faces; needed some of both")
    first, last = int(mesh.faces.min()), int(mesh.faces.max())
    if first < 0 or last >= len(mesh.vertices):
        count = len(mesh.vertices)
        raise ValueError(f"faces name vertices {first} to {last} of {count}; needed ones that exist")


def standing(vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
    """The same shape standing on z = 0, the middle of its footprint at the origin."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return vertices - [*(low + high)[:2] / 2, low[2]]
