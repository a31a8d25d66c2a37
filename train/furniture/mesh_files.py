"""Meshes as files: a folder of them, or a table that lists them."""

from __future__ import annotations

import csv
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import cast, get_args

import numpy as np
import trimesh

from train.furniture.source_mesh import SourceMesh, Split

MESH_SUFFIXES = (".obj", ".glb", ".off", ".ply", ".stl")
UNREADABLE = (ValueError, IndexError, KeyError, OSError, struct.error, AttributeError, TypeError)
Report = Callable[[str, str], None]  # name of a mesh, and why it could not be read


def read_mesh_file(
    path: Path, name: str, category: str, source: str, license: str = "unknown", split: Split | None = None
) -> SourceMesh:
    """One mesh file. Raises ValueError if it is none, or has no faces."""
    try:
        mesh = trimesh.load_mesh(path)
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    except UNREADABLE as error:
        raise ValueError(f"{path}: not a readable mesh ({' '.join(str(error).split())})") from error
    return SourceMesh(
        name=name,
        category=category,
        vertices=vertices.reshape(-1, 3),
        faces=faces.reshape(-1, 3),
        source=source,
        license=license,
        split=split,
    )


def read_folder(folder: Path, report: Report | None = None) -> Iterator[SourceMesh]:
    """The meshes of a folder and its sub-folders, which name the categories.

    A file that cannot be read goes to `report`; without one it raises ValueError.
    """
    for file in sorted(p for p in folder.rglob("*") if p.suffix.lower() in MESH_SUFFIXES):
        name = file.relative_to(folder).as_posix()
        category = file.parent.name if file.parent != folder else "object"
        yield from attempt(lambda: read_mesh_file(file, name, category, folder.name), name, report)  # noqa: B023


def read_table(table: Path, report: Report | None = None) -> Iterator[SourceMesh]:
    """The meshes that a CSV lists: column `path`, relative to it, and optional category, split and license.

    A file that cannot be read goes to `report`; without one, and for a table that is none, ValueError.
    """
    with table.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    if rows and "path" not in rows[0]:
        raise ValueError(f"{table}: columns {', '.join(rows[0])}; needed path")
    for row in rows:
        yield from attempt(lambda: _read_row(table, row), row["path"], report)  # noqa: B023


def _read_row(table: Path, row: dict[str, str]) -> SourceMesh:
    split = (row.get("split") or "").strip() or None
    if split is not None and split not in get_args(Split):
        raise ValueError(f"{table}: {row['path']}: split {split!r}; needed {', '.join(get_args(Split))}")
    return read_mesh_file(
        table.parent / row["path"],
        row["path"],
        (row.get("category") or "").strip() or "object",
        table.stem,
        (row.get("license") or row.get("licence") or "").strip() or "unknown",
        cast("Split | None", split),
    )


def attempt(read: Callable[[], SourceMesh], name: str, report: Report | None) -> Iterator[SourceMesh]:
    """What `read` returns; if it raises ValueError, nothing, and a line for `report` where there is one."""
    try:
        yield read()
    except ValueError as error:
        if report is None:
            raise
        report(name, str(error))
