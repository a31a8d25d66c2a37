"""Packed collections: many meshes in one .npz, 16 bits a coordinate."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from train.furniture.source_mesh import SourceMesh, name_digest

LEVELS = 65535.0  # of a packed coordinate
NEEDED = {"vertices", "faces", "names", "n_vertices", "n_faces", "lo", "hi"}
INFINIGEN_LICENSE = "output of Infinigen's generators (BSD-3-Clause)"
# Of collections that say no licenses, by how the last part of a mesh's name begins.
LICENSES = {
    "kaykit_": "CC0-1.0, Kay Lousberg (KayKit)",
    "cob_": "Apache-2.0, ipa320/cob_simulation; meshes merged, rescaled, centered and quantized",
    "aws_": "MIT-0, Amazon.com, Inc. or its affiliates (aws-robomaker-bookstore-world)",
}


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
        licenses=np.array([m.license for m in meshes]),
        lo=low,
        hi=high,
        n_vertices=np.array([len(m.vertices) for m in meshes]),
        n_faces=np.array([len(m.faces) for m in meshes]),
    )


def read_packed(path: Path) -> Iterator[SourceMesh]:
    """The meshes of a packed .npz. Raises ValueError if it is damaged or lacks an array."""
    try:
        with np.load(path, allow_pickle=False) as packed:
            arrays = {name: packed[name] for name in packed.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: not a readable .npz ({error}); needed packed meshes") from error
    if missing := sorted(NEEDED - set(arrays)):
        raise ValueError(f"{path}: packed meshes lack {', '.join(missing)}")
    infinigen = path.stem.startswith("infinigen_")
    vertices = np.split(arrays["vertices"], np.cumsum(arrays["n_vertices"])[:-1])
    faces = np.split(arrays["faces"], np.cumsum(arrays["n_faces"])[:-1])
    # A collection without categories is of one, which its file is named after.
    categories = arrays.get("categories", [path.stem.removeprefix("infinigen_")] * len(vertices))
    licenses = arrays.get("licenses", arrays.get("licences"))
    if licenses is None:
        licenses = [INFINIGEN_LICENSE if infinigen else license_of(str(n)) for n in arrays["names"]]
    rows = zip(
        arrays["names"], categories, licenses, vertices, faces, arrays["lo"], arrays["hi"], strict=True
    )
    for name, category, license, v, f, lo, hi in rows:
        yield SourceMesh(
            name=str(name),
            category=str(category),
            vertices=_in_meters(str(name) if infinigen else "", lo + v / LEVELS * (hi - lo)),
            faces=f.astype(np.int64),
            source=path.name,
            license=str(license),
        )


def _in_meters(name: str, vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
    """Infinigen's trash cans alone are not metric: the name decides on a height of 0.25 to 0.7 m."""
    if not name.startswith("TrashFactory"):
        return vertices
    share = name_digest(name) % 1000 / 999
    return vertices * ((0.25 + 0.45 * share) / np.ptp(vertices[:, 2]))


def license_of(name: str) -> str:
    """The license of a mesh whose collection says none, by its name."""
    last = name.rsplit("/", 1)[-1]
    return next((text for start, text in LICENSES.items() if last.startswith(start)), "unknown")
