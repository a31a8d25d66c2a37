"""Scans as people have them, read into a `Scan`: PLY, NPZ, or a folder of one PLY per object.

A further format is one more row of `FORMATS`.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from more2_jax.data.ply import INSTANCE_PROPERTIES, PlyCloud, read_ply
from more2_jax.types import Instance, Scan, Skipped

UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001}
SMALLEST_M, LARGEST_M = 0.02, 20.0  # a median object beyond these means another unit than was said
CM_OR_MM = 380.0  # between 120 and 1200, a chair in either
# What NumPy and zipfile raise for files that are damaged, encrypted, pickled, or a lone array.
UNREADABLE = (
    ValueError,
    OSError,
    EOFError,
    zipfile.BadZipFile,
    zlib.error,
    TypeError,
    RuntimeError,
    KeyError,
)


@dataclass(frozen=True, kw_only=True)
class LabelledCloud:
    """What every format comes down to: points with the instance they belong to."""

    points: Float[np.ndarray, "n 3"]  # float64, in the file's unit
    instance: Int[np.ndarray, "n"]  # 0 and negative: background
    colors: Int[np.ndarray, "n 3"] | None = None  # uint8
    point_labels: np.ndarray | None = None  # (n,) str or integer
    labels: dict[int, str] = field(default_factory=dict)  # instance → label, where the format says it once
    skipped: tuple[Skipped, ...] = ()


def read_scan(
    path: str | Path, *, instance_property: str | None = None, unit: str = "m", min_points: int = 64
) -> Scan:
    """Reads one scan: instances in metres (float64, the scan's own frame), and what was left out.

    `path` is a PLY whose vertices carry an integer property naming the instance (`instance`, `instance_id`,
    `objectId`, `object_id` or `label`, in this order; `instance_property` names another), an NPZ with
    `points` (n, 3), `instance` (n,) and optional `label` (n,), `color` (n, 3), or a folder of one PLY per
    object. Instance ids ≤ 0 are background. `unit` is the file's: m, cm or mm. Instances of fewer than
    `min_points` points are reported in `Scan.skipped`; sizes that look like another unit, in `Scan.warnings`.

    Raises ValueError, in one line, when the file is missing, unknown, damaged, has no instance property, has
    coordinates that are not finite, or no instance is left.
    """
    path = Path(path)
    if unit not in UNITS_M:
        raise ValueError(f"unit {unit!r}; needed one of {', '.join(UNITS_M)}")
    if not path.exists():
        raise ValueError(f"{path}: no such file or folder")
    for recognises, read in FORMATS:
        if recognises(path):
            return _scan(path, read(path, instance_property), unit, min_points)
    what = "a folder without .ply files" if path.is_dir() else f"suffix {path.suffix!r}"
    raise ValueError(f"{path}: {what}; needed a .ply, an .npz, or a folder of one .ply per object")


# --- formats: how each is recognised and read ---------------------------------------------------------------


def _read_ply_scan(path: Path, instance_property: str | None) -> LabelledCloud:
    cloud = read_ply(path)
    name = _instance_property(path, cloud, instance_property)
    labels = cloud.properties.get("label") if name != "label" else None
    return LabelledCloud(
        points=cloud.points,
        instance=cloud.properties[name].astype(np.int64),
        colors=cloud.colors,
        point_labels=labels if labels is not None and labels.dtype.kind in "iu" else None,
    )


def _instance_property(path: Path, cloud: PlyCloud, asked: str | None) -> str:
    integers = cloud.integer_properties
    wanted = INSTANCE_PROPERTIES if asked is None else (asked,)
    for name in wanted:
        if name in integers:
            return name
    has = f"integer properties are {', '.join(integers)}" if integers else "it has no integer property"
    raise ValueError(
        f"{path}: no integer vertex property {' or '.join(wanted)} names the instance; {has}"
        + (" (choose one with --instance-property)" if integers else "")
    )


def _read_npz_scan(path: Path, instance_property: str | None) -> LabelledCloud:
    key = instance_property or "instance"
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {k: file[k] for k in ("points", key, "label", "color") if k in file.files}
            names = ", ".join(file.files) or "nothing"
    except UNREADABLE as error:
        raise ValueError(f"{path}: not a readable NPZ file ({' '.join(str(error).split())})") from error
    if missing := [k for k in ("points", key) if k not in arrays]:
        raise ValueError(f"{path}: arrays are {names}; needed {' and '.join(missing)} too")
    _check_npz(path, arrays, key)
    labels = arrays.get("label") if key != "label" else None
    return LabelledCloud(
        points=arrays["points"].astype(np.float64),
        instance=arrays[key].astype(np.int64),
        colors=_colors(arrays.get("color")),
        point_labels=labels,
    )


def _check_npz(path: Path, arrays: dict[str, np.ndarray], key: str) -> None:
    points, count = arrays["points"], len(np.atleast_1d(arrays["points"]))
    needed = {"points": ((count, 3), "iuf"), key: ((count,), "iu"), "color": ((count, 3), "iuf")}
    needed |= {"label": ((count,), "iuUS")} if key != "label" else {}
    if points.ndim != 2:
        raise ValueError(f"{path}: points have shape {points.shape}; needed (n, 3)")
    for name, (shape, kinds) in needed.items():
        array = arrays.get(name)
        if array is not None and array.shape != shape:
            raise ValueError(f"{path}: {name} has shape {array.shape}; needed {shape}")
        if array is not None and array.dtype.kind not in kinds:
            raise ValueError(f"{path}: {name} holds {array.dtype}; needed {_kinds_in_words(kinds)}")


def _kinds_in_words(kinds: str) -> str:
    words = {"iu": "integers", "iuf": "numbers", "iuUS": "integers or strings"}
    return words[kinds]


def _colors(colors: np.ndarray | None) -> np.ndarray | None:
    if colors is None:
        return None
    return np.clip(colors * 255.0 if colors.dtype.kind == "f" else colors, 0, 255).astype(np.uint8)


def _read_folder_scan(path: Path, instance_property: str | None) -> LabelledCloud:
    """One PLY, one object. `instance_property` has nothing to choose here."""
    files = sorted(path.glob("*.ply"))
    clouds = [read_ply(file) for file in files]
    ids = _folder_ids([file.stem for file in files])
    colors = [cloud.colors for cloud in clouds if cloud.colors is not None]
    return LabelledCloud(
        points=np.concatenate([cloud.points for cloud in clouds]),
        instance=np.repeat(np.array(ids, np.int64), [len(cloud.points) for cloud in clouds]),
        colors=np.concatenate(colors) if len(colors) == len(clouds) else None,
        labels={i: file.stem for i, file in zip(ids, files, strict=True)},
        skipped=tuple(
            Skipped(what=file.name, reason="no points")
            for file, cloud in zip(files, clouds, strict=True)
            if not len(cloud.points)
        ),
    )


def _folder_ids(stems: list[str]) -> list[int]:
    """The trailing digits of every name where they are positive and unique, else 1, 2, …"""
    digits = [re.search(r"\d+$", stem) for stem in stems]
    numbers = [int(found[0]) for found in digits if found]
    named = len(set(numbers)) == len(stems) and min(numbers) > 0 and max(numbers) < 2**31
    return numbers if named else list(range(1, len(stems) + 1))


Recognise = Callable[[Path], bool]
Read = Callable[[Path, str | None], LabelledCloud]
FORMATS: tuple[tuple[Recognise, Read], ...] = (
    (lambda path: path.is_file() and path.suffix.lower() == ".ply", _read_ply_scan),
    (lambda path: path.is_file() and path.suffix.lower() == ".npz", _read_npz_scan),
    (lambda path: path.is_dir() and any(path.glob("*.ply")), _read_folder_scan),
)


# --- from labelled points to instances ----------------------------------------------------------------------


def _scan(path: Path, cloud: LabelledCloud, unit: str, min_points: int) -> Scan:
    if not len(cloud.points):
        raise ValueError(f"{path}: no instances left; the scan has no points")
    if bad := int((~np.isfinite(cloud.points).all(axis=1)).sum()):
        raise ValueError(f"{path}: {bad} of {len(cloud.points)} points have NaN or infinite coordinates")
    points = cloud.points * UNITS_M[unit]
    kept, skipped = _instances(cloud, points, min_points)
    if not kept:
        raise ValueError(f"{path}: no instances left; {_why_none(cloud, skipped, min_points)}")
    background = points[cloud.instance <= 0]
    return Scan(
        name=path.stem if path.is_file() else path.resolve().name,
        source=str(path),
        instances=kept,
        background=background,
        skipped=(*cloud.skipped, *skipped),
        warnings=_unit_warnings(kept, unit),
    )


def _instances(
    cloud: LabelledCloud, points: Float[np.ndarray, "n 3"], min_points: int
) -> tuple[tuple[Instance, ...], tuple[Skipped, ...]]:
    """Splits the points by instance in one sort; ids ascend, points keep the file's order."""
    order = np.argsort(cloud.instance, kind="stable")
    ids, starts = np.unique(cloud.instance[order], return_index=True)
    kept: list[Instance] = []
    skipped: list[Skipped] = []
    for index, rows in zip(ids.tolist(), np.split(order, starts[1:]), strict=True):
        if index <= 0:
            continue
        if len(rows) < min_points:
            reason = f"{len(rows)} points; needed {min_points}"
            skipped.append(Skipped(what=f"instance {index}", reason=reason))
            continue
        colors = None if cloud.colors is None else cloud.colors[rows]
        kept.append(Instance(id=index, points=points[rows], label=_label(cloud, index, rows), colors=colors))
    return tuple(kept), tuple(skipped)


def _label(cloud: LabelledCloud, index: int, rows: np.ndarray) -> str | None:
    """What most of the instance's points say; the first in order where two say it equally often."""
    if cloud.point_labels is None:
        return cloud.labels.get(index)
    values, counts = np.unique(cloud.point_labels[rows], return_counts=True)
    most = values[np.argmax(counts)]
    text = most.decode("utf-8", "replace") if isinstance(most, bytes) else str(most)
    return text or None


def _why_none(cloud: LabelledCloud, skipped: tuple[Skipped, ...], min_points: int) -> str:
    background = int((cloud.instance <= 0).sum())
    if not skipped:
        return f"all {background} points are background (instance ≤ 0)"
    return f"{len(skipped)} had fewer than {min_points} points; {background} points are background"


def median_diagonal(instances: tuple[Instance, ...]) -> float:
    """Median over instances of the diagonal of the bounding box, in the unit of their points."""
    return float(np.median([np.linalg.norm(np.ptp(i.points, axis=0)) for i in instances]))


def likely_unit(diagonal: float) -> str:
    """The unit in which furniture would have this diagonal: 1 or 2 m, 100 or 200 cm, 1000 or 2000 mm."""
    if diagonal <= LARGEST_M:
        return "m"
    return "cm" if diagonal <= CM_OR_MM else "mm"


def _unit_warnings(instances: tuple[Instance, ...], unit: str) -> tuple[str, ...]:
    diagonal_m = median_diagonal(instances)
    if SMALLEST_M <= diagonal_m <= LARGEST_M:
        return ()
    likely = likely_unit(diagonal_m / UNITS_M[unit])
    advice = f"; if the scan is in {likely}, pass --unit {likely}" if likely != unit else ""
    return (f"the median object measures {diagonal_m:.4g} m across, which is unlikely for furniture{advice}",)
