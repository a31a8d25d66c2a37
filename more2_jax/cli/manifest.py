"""The manifest of `more2 batch`: a CSV or Parquet file, a scene a row, its columns the options of `more2 run`."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

from more2_jax.cli.options import Axis, Reading, Segment, Unit
from more2_jax.cli.settings import scene_config
from more2_jax.cli.tables import needs_parquet
from more2_jax.config import PresetName, SceneConfig

SEPARATOR = ";"  # between the scans of a cell of CSV
YES, NO = ("true", "yes", "1"), ("false", "no", "0")


@dataclass(frozen=True, kw_only=True)
class SceneJob:
    """One row: what `more2 run` is told of a scene. Paths are absolute."""

    row: int  # from 1, without the head
    name: str
    scans: tuple[Path, ...]
    out: Path
    masks: tuple[Path, ...] = ()
    preset: str = "robust"
    upright: bool | None = None  # as the first scan's floor says
    prior: str = "small"
    keep_masks: bool = False
    config: Path | None = None
    reading: Reading = field(default_factory=Reading)

    def settings(self) -> SceneConfig:
        """The settings of the scene. Raises ValueError for a file of settings that does not fit."""
        return scene_config(self.preset, self.upright, self.config, keep_masks=self.keep_masks)


@dataclass(frozen=True, kw_only=True)
class RottenRow:
    """A row that is no scene, and in one line why."""

    row: int
    name: str
    error: str


def read_manifest(path: Path, out: Path) -> list[SceneJob | RottenRow]:
    """The rows of a manifest; folders of scenes are below `out`, scans beside the manifest, unless absolute.

    A row that cannot be used is a `RottenRow`. Raises ValueError, in one line, if the file cannot be read, has no
    rows, no column `scans`, or one that is unknown.
    """
    columns, rows = _read_parquet(path) if path.suffix == ".parquet" else _read_csv(path)
    if unknown := [c for c in columns if c not in CELLS and c != "out"]:
        raise ValueError(f"{path}: unknown column {', '.join(unknown)}; known are out, {', '.join(CELLS)}")
    if not {"name", "scans"} <= set(columns):
        raise ValueError(f"{path}: columns {', '.join(columns)}; needed name and scans")
    if not rows:
        raise ValueError(f"{path}: no rows; needed a scene at least")
    found: list[SceneJob | RottenRow] = []
    taken: dict[Path, int] = {}
    for number, cells in enumerate(rows, start=1):
        name = str(cells.get("name") or "")
        try:
            job = _job(number, cells, path.resolve().parent, out.resolve())
            if job.out in taken:
                raise ValueError(f"its folder {job.out} is that of row {taken[job.out]}; needed its own")
        except ValueError as error:
            found.append(RottenRow(row=number, name=name, error=str(error)))
        else:
            taken[job.out] = number
            found.append(job)
    return found


def _read_csv(path: Path) -> tuple[Sequence[str], list[dict[Any, Any]]]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            return reader.fieldnames or (), list(reader)
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: neither CSV in UTF-8 ({error}) nor called .parquet") from error


def _read_parquet(path: Path) -> tuple[Sequence[str], list[dict[Any, Any]]]:
    arrow, parquet = needs_parquet(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        table = parquet.read_table(path)
    except (arrow.ArrowException, OSError) as error:
        raise ValueError(f"{path}: not Parquet ({' '.join(str(error).split())})") from error
    return table.column_names, table.to_pylist()


def _job(number: int, cells: Mapping[Any, Any], base: Path, out: Path) -> SceneJob:
    if None in cells:
        raise ValueError(f"{len(cells[None])} cells more than columns")
    values = {c: read(cells[c], base) for c, read in CELLS.items() if not _empty(cells.get(c))}
    for needed in ("name", "scans"):
        if not values.get(needed):
            raise ValueError(f"no {needed}; needed one")
    folder = str(cells["out"]) if not _empty(cells.get("out")) else _folder_named(values["name"])
    of_reading = {f.name for f in dataclasses.fields(Reading)}
    reading = Reading(**{k: v for k, v in values.items() if k in of_reading})
    own = {k: v for k, v in values.items() if k not in of_reading}
    job = SceneJob(row=number, out=(out / folder).resolve(), reading=reading, **own)
    if len(job.masks) not in (0, len(job.scans)):
        raise ValueError(f"{len(job.masks)} masks for {len(job.scans)} scans; needed none, or one a scan")
    for file in (*job.scans, *job.masks):
        if not file.exists():
            raise ValueError(f"{file}: no such file or folder")
    job.settings()
    return job


def _empty(cell: Any) -> bool:
    """Nothing in it: the option keeps its default."""
    return cell is None or (isinstance(cell, str) and not cell.strip())


def _folder_named(name: str) -> str:
    if name in (".", "..") or Path(name).name != name:
        raise ValueError(f"name {name!r} is no name of a folder; needed one, or a column out")
    return name


def _text(cell: Any, base: Path) -> str:
    return str(cell).strip()


def _paths(cell: Any, base: Path) -> tuple[Path, ...]:
    """Of a list, or of text with separators; relative ones lie beside the manifest."""
    parts = cell.split(SEPARATOR) if isinstance(cell, str) else cell
    if not isinstance(parts, list):
        raise ValueError(f"got {cell!r}; needed a list of paths")
    return tuple((base / str(p).strip()).resolve() for p in parts if not _empty(p))


def _path(cell: Any, base: Path) -> Path:
    return (base / str(cell).strip()).resolve()


def _flag(cell: Any, base: Path) -> bool:
    word = str(cell).strip().lower()
    if word not in (*YES, *NO):
        raise ValueError(f"got {cell!r}; needed true or false")
    return word in YES


def _one_of(kinds: Any) -> Callable[[Any, Path], str]:
    def read(cell: Any, base: Path) -> str:
        if (word := str(cell).strip()) not in get_args(kinds):
            raise ValueError(f"got {cell!r}; needed one of {', '.join(get_args(kinds))}")
        return word

    return read


def _prior(cell: Any, base: Path) -> str:
    """A file beside the manifest, or a name of shipped weights."""
    file = _path(cell, base)
    return str(file) if file.is_file() else _text(cell, base)


CELLS: dict[str, Callable[[Any, Path], Any]] = {
    "name": _text,
    "scans": _paths,
    "masks": _paths,
    "preset": _one_of(PresetName),
    "upright": _flag,
    "prior": _prior,
    "keep_masks": _flag,
    "config": _path,
    "unit": _one_of(Unit),
    "instance_property": _text,
    "segment": _one_of(Segment),
    "up": _one_of(Axis),
    "depth_frames": _flag,
}
