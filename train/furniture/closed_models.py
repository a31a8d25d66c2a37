"""Models of a benchmark: closed, in meters, z up, standing on z = 0; made once and kept in a folder."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Literal
from uuid import uuid4

import numpy as np

from train.furniture.closed_solids import watertight
from train.furniture.collections import SourceMesh, check_mesh, read_meshes, standing
from train.furniture.heldout import read_ikea
from train.furniture.sweethome3d import Z_UP
from train.furniture.symmetry import yaw_symmetry

VERSION = 1  # of how models are closed: another number makes them anew
SMALLEST_M, LARGEST_M = 0.05, 5.0  # longest edge that furniture has
GRID_DECIMALS = 6  # of vertices, meters


def read_models(
    path: Path,
    *,
    up: Literal["y", "z"] = "z",
    longest_m: float | Mapping[str, float] | None = None,
    license: str | None = None,
    unreadable: dict[str, str] | None = None,
) -> list[SourceMesh]:
    """The meshes of a collection in meters, z up, ordered by name; names are unique.

    `heldout_ikea.npz` is recognized by its name and brought to plausible sizes. Of any other source `up` tells
    the vertical axis, and `longest_m` (for all, or by category) the longest edge to scale each mesh to; without
    it coordinates are meters. `license` is for meshes that come without one. Unreadable ones go into
    `unreadable`, with the reason. Raises ValueError if there is no such collection, or it has no meshes.
    """
    if path.stem == "heldout_ikea":
        meshes = list(read_ikea(path))
    else:
        report = None if unreadable is None else (lambda name, why: unreadable.update({name: why}))
        meshes = [_metric(m, up, longest_m) for m in read_meshes(path, report)]
    if not meshes:
        raise ValueError(f"{path}: no meshes; needed some")
    named: dict[str, SourceMesh] = {}
    for mesh in sorted(meshes, key=lambda m: (m.name, m.content_hash)):
        name = mesh.name if mesh.name not in named else f"{mesh.name}#{mesh.content_hash[:8]}"
        known = mesh.license != "unknown" or license is None
        named[name] = dataclasses.replace(mesh, name=name, license=mesh.license if known else license)
    return list(named.values())


def _metric(
    mesh: SourceMesh, up: Literal["y", "z"], longest_m: float | Mapping[str, float] | None
) -> SourceMesh:
    check_mesh(mesh)
    vertices = mesh.vertices @ Z_UP.T if up == "y" else mesh.vertices
    if isinstance(longest_m, Mapping) and mesh.category not in longest_m:
        raise ValueError(f"{mesh.name}: category {mesh.category!r}; needed one of {', '.join(longest_m)}")
    if longest_m is not None:
        wanted = longest_m[mesh.category] if isinstance(longest_m, Mapping) else longest_m
        vertices = vertices * (wanted / max(1e-12, float(np.ptp(vertices, axis=0).max())))
    return dataclasses.replace(mesh, vertices=vertices)


def closed_model(mesh: SourceMesh) -> tuple[SourceMesh, int]:
    """The mesh as a closed solid standing on z = 0, and the order of its symmetry about the vertical.

    Raises ValueError if it cannot be closed or has no furniture's size.
    """
    longest = float(np.ptp(mesh.vertices, axis=0).max())
    if not SMALLEST_M <= longest <= LARGEST_M:
        raise ValueError(f"{longest:.3g} m long; needed {SMALLEST_M} to {LARGEST_M} m: see --longest-m")
    vertices, faces = watertight(mesh.vertices, mesh.faces)
    vertices = np.round(standing(vertices), GRID_DECIMALS)
    return dataclasses.replace(mesh, vertices=vertices, faces=faces), yaw_symmetry(vertices, faces)


def cache_name(mesh: SourceMesh) -> str:
    """Of the file that keeps a model: depends on its geometry, to the bit, and on how models are closed.

    Not on `content_hash`, which rounds: meshes equal to single precision can close to other vertices, and then
    the model would depend on which of them came first.
    """
    geometry = mesh.vertices.astype("<f8").tobytes() + mesh.faces.astype("<i4").tobytes()
    return hashlib.sha1(f"{VERSION} ".encode() + geometry).hexdigest() + ".npz"


def make_cached(mesh: SourceMesh, cache: Path) -> str | None:
    """Closes the mesh and keeps it in `cache`; returns why that is impossible, or None. A second call is free.

    Any number of processes, on any machines, may share the folder: files are named by content and renamed whole.
    """
    target = cache / cache_name(mesh)
    reasons = target.with_suffix(".json")
    if target.exists():
        return None
    if reasons.exists():
        return json.loads(reasons.read_text())["reason"]
    try:
        model, symmetry = closed_model(mesh)
    except ValueError as error:
        atomically(reasons, json.dumps({"reason": str(error)}).encode())
        return str(error)
    partial = target.with_suffix(f".{uuid4().hex}.partial.npz")
    np.savez(partial, vertices=model.vertices, faces=model.faces.astype(np.int32), symmetry=symmetry)
    partial.replace(target)
    return None


def atomically(path: Path, content: bytes) -> None:
    """Writes the file whole or not at all; any number of processes may at a time, and the last one stays."""
    partial = path.with_suffix(f".{uuid4().hex}.partial")
    partial.write_bytes(content)
    partial.replace(path)


def read_cached(meshes: Sequence[SourceMesh], cache: Path) -> tuple[list[SourceMesh], dict[str, int]]:
    """The closed models of those meshes that could be closed, and the symmetry order of each, by name."""
    models, symmetry = [], {}
    for mesh in meshes:
        if (cache / cache_name(mesh)).exists():
            vertices, faces, symmetry[mesh.name] = _load(cache / cache_name(mesh))
            models.append(dataclasses.replace(mesh, vertices=vertices, faces=faces))
    return models, symmetry


@lru_cache(maxsize=4096)
def _load(path: Path) -> tuple[np.ndarray, np.ndarray, int]:
    with np.load(path, allow_pickle=False) as file:
        return file["vertices"], file["faces"].astype(np.int64), int(file["symmetry"])
