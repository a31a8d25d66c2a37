"""S3DIS (Armeni et al. 2016): a room with `Annotations/<class>_<number>.txt`, lines of x y z r g b, meters.

The published files have lines with stray control characters (Area_5/hallway_6/Annotations/ceiling_1.txt).
Up to `MOST_DAMAGED` such lines of a file are left out, and a warning names the first; more are an error.
"""

from __future__ import annotations

import re
import warnings
from array import array
from pathlib import Path

import numpy as np
from jaxtyping import Float

from more2_jax.scans.labeled_cloud import LabeledCloud, ReadOptions
from more2_jax.scans.structural_labels import is_background
from more2_jax.types import Skipped

FOLDER = "Annotations"
NAME = re.compile(r"(.+)_(\d{1,9})\.txt")
COLUMNS = 6
MOST_DAMAGED = 10  # lines of a file


def recognizes(path: Path) -> bool:
    """Whether this is a room's folder, or its folder of annotations."""
    return _folder(path) is not None


def read(path: Path, options: ReadOptions) -> LabeledCloud:
    """One file, one instance, numbered from 1 by class and number; walls, floors and the like are background.

    Raises ValueError, in one line with file and line number, when a file is damaged or no file has points.
    """
    folder = _folder(path)
    if folder is None:
        raise ValueError(f"{path}: no folder {FOLDER} with <class>_<number>.txt")
    named = sorted((found[1], int(found[2]), file) for file in folder.iterdir() if (found := _named(file)))
    skipped = [Skipped(what=f.name, reason="not <class>_<number>.txt") for f in _strangers(folder)]
    tables, ids, labels, remarks, count = [np.zeros((0, COLUMNS))], [0], {}, [], 0
    for label, _, file in named:
        table, remark = _table(file)
        remarks += remark
        structural = is_background(label)
        if structural or not len(table):
            reason = "background: its label is no movable object" if structural else "no points"
            skipped.append(Skipped(what=file.name, reason=reason))
        else:
            count += 1
            labels[count] = label
        tables.append(table)
        ids.append(0 if structural else count)
    table = np.concatenate(tables)
    return LabeledCloud(
        points=table[:, :3].copy(),
        instance=None if options.masks else np.repeat(np.array(ids, np.int64), [len(t) for t in tables]),
        colors=np.clip(np.nan_to_num(table[:, 3:]), 0, 255).astype(np.uint8),
        labels=labels,
        skipped=tuple(skipped),
        unit="m",
        warnings=tuple(remarks),
    )


def _folder(path: Path) -> Path | None:
    for folder in (path / FOLDER, path):
        if folder.name == FOLDER and folder.is_dir() and any(map(_named, folder.glob("*.txt"))):
            return folder
    return None


def _named(file: Path) -> re.Match[str] | None:
    return NAME.fullmatch(file.name)


def _strangers(folder: Path) -> list[Path]:
    return [f for f in sorted(folder.iterdir()) if not _named(f) and not f.name.startswith(".")]


def _table(file: Path) -> tuple[Float[np.ndarray, "n 6"], list[str]]:
    """The rows of a file, and a remark on lines left out; fast where all lines are whole."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an empty file
            table = np.loadtxt(file, np.float64, comments=None, encoding="latin-1", ndmin=2)
    except (ValueError, OSError):
        return _line_by_line(file)
    if not table.size:
        return np.zeros((0, COLUMNS)), []
    return (table, []) if table.shape[1] == COLUMNS else _line_by_line(file)


def _line_by_line(file: Path) -> tuple[Float[np.ndarray, "n 6"], list[str]]:
    numbers, damaged = array("d"), []
    with file.open(encoding="latin-1", newline="\n") as lines:
        for number, line in enumerate(lines, 1):
            words = line.split()
            if not words:
                continue
            try:
                row = [float(word) for word in words]
            except ValueError:
                row = []
            if len(row) == COLUMNS:
                numbers.extend(row)
                continue
            damaged.append(number)
            if len(damaged) > MOST_DAMAGED:
                raise ValueError(f"{file}: line {damaged[0]} and {MOST_DAMAGED} more are not x y z r g b")
    if damaged and not numbers:
        raise ValueError(f"{file}: line {damaged[0]} is not x y z r g b, and no other line is")
    table = np.frombuffer(numbers, np.float64).reshape(-1, COLUMNS)
    if not damaged:
        return table, []
    return table, [f"{file.name}: {len(damaged)} damaged lines left out, the first is line {damaged[0]}"]
