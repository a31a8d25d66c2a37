"""Training shapes in one small file, to carry where the shards are too large to go.

Coordinates are steps of a cube: 256 for points of views, whose noise is coarser, 4096 for queries and distances.
Normals are a byte a coordinate as they are in shards.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt16

from train.shards.shards import Shapes

HALF = 0.7  # canonical units: half the cube; shapes reach 0.45, queries and distances a little further
LEVELS = {"views": 2**8, "sdf_uniform": 2**12, "sdf_near": 2**12}


def to_steps(values: Float[np.ndarray, "..."], levels: int) -> UInt16[np.ndarray, "..."]:
    """Canonical units as steps of the cube; what lies outside moves to its border."""
    steps = np.round((values.astype(np.float32) + HALF) / (2 * HALF) * (levels - 1))
    return np.clip(steps, 0, levels - 1).astype(np.uint16)


def from_steps(steps: UInt16[np.ndarray, "..."], levels: int) -> Float[np.ndarray, "..."]:
    """The middle of every step, float16."""
    return (steps.astype(np.float32) / (levels - 1) * (2 * HALF) - HALF).astype(np.float16)


def write_shapes(path: Path, splits: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Writes the arrays `views`, `normals`, `sdf_uniform` and `sdf_near` of every split into one .npz.

    And `scanned`, if they have it.
    """
    stored: dict[str, np.ndarray] = {}
    for split, arrays in splits.items():
        stored |= {f"{split}/{name}": arrays[name] for name in ("normals", "scanned") if name in arrays}
        for name, levels in LEVELS.items():
            steps = to_steps(arrays[name], levels)
            stored[f"{split}/{name}/low"] = (steps & 255).astype(np.uint8)
            if levels > 256:  # a plane of their own, which compresses; mixed with the low bits they do not
                stored[f"{split}/{name}/high"] = (steps >> 8).astype(np.uint8)
    np.savez_compressed(path, **stored)  # type: ignore[arg-type]


def read_shapes(path: Path, split: str) -> Shapes:
    """The shapes of a split, as NumPy arrays. ValueError if the file is damaged or has none."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {k: file[k] for k in file.files if k.startswith(f"{split}/")}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"{path}: not a readable .npz ({error}); `python -m train.tools.pack` makes one"
        ) from error
    if missing := [name for name in LEVELS if f"{split}/{name}/low" not in arrays]:
        raise ValueError(f"{path}: no {split}/{missing[0]}; `python -m train.tools.pack` makes such files")
    read = {name: _array(arrays, f"{split}/{name}", levels) for name, levels in LEVELS.items()}
    normals = arrays.get(f"{split}/normals", np.zeros(read["views"].shape, np.int8))  # zeros: not known
    scanned = np.asarray(arrays.get(f"{split}/scanned", np.zeros(len(normals))), bool)
    return Shapes(**read, normals=normals, scanned=scanned)  # pyright: ignore[reportArgumentType]


def _array(arrays: Mapping[str, np.ndarray], name: str, levels: int) -> Float[np.ndarray, "..."]:
    steps = arrays[f"{name}/low"].astype(np.uint16)
    if levels > 256:
        steps |= arrays[f"{name}/high"].astype(np.uint16) << 8
    return from_steps(steps, levels)
