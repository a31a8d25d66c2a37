"""PLY files as the data sets have them: any scalar columns; faces of any number of corners, with columns too."""

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement


def _table(columns: dict[str, np.ndarray]) -> np.ndarray:
    rows = np.empty(len(next(iter(columns.values()))), [(name, c.dtype) for name, c in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    return rows


def vertex_columns(points: np.ndarray, colors: np.ndarray | None = None, **more: np.ndarray) -> dict:
    """x y z as float, red green blue as uchar, then more."""
    columns = {axis: points[:, i].astype("f4") for i, axis in enumerate("xyz")}
    if colors is not None:
        columns |= {name: colors[:, i].astype("u1") for i, name in enumerate(("red", "green", "blue"))}
    return columns | more


def write_ply(path: Path, columns: dict, faces=(), *, face_columns=None, text=False) -> Path:
    """`faces` is a list of lists of vertices; they may differ in length."""
    elements = [PlyElement.describe(_table(columns), "vertex")]
    if len(faces):
        more = face_columns or {}
        dtype = [("vertex_indices", "O"), *((name, column.dtype) for name, column in more.items())]
        rows = np.empty(len(faces), dtype)
        for i, corners in enumerate(faces):
            rows["vertex_indices"][i] = np.array(corners, np.int32)
        for name, column in more.items():
            rows[name] = column
        kinds = {"val_types": {"vertex_indices": "i4"}, "len_types": {"vertex_indices": "u1"}}
        elements.append(PlyElement.describe(rows, "face", **kinds))
    path.parent.mkdir(parents=True, exist_ok=True)
    PlyData(elements, text=text, byte_order="=" if text else "<").write(str(path))
    return path
