"""Predicted masks laid over a cloud: Mask3D and the ScanNet benchmark (paper §4), or NPZ."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Bool, Float

from more2_jax.scans.files.npz import read_arrays
from more2_jax.scans.labeled_cloud import LabeledCloud, instance_ids, one_line
from more2_jax.types import Skipped

PER_POINT = ("objectId", "instance")  # arrays of an NPZ with one instance a point


@dataclass(frozen=True, kw_only=True)
class Mask:
    """One predicted instance: which points it covers, and how sure the network is."""

    name: str
    covers: Bool[np.ndarray, "n"]
    score: float = 1.0
    label: str | None = None


def lay_masks(cloud: LabeledCloud, scan: Path, path: Path, min_score: float) -> LabeledCloud:
    """The cloud with the masks as its instances, numbered from 1 as the file lists them.

    `path` is a benchmark file (`<scene>.txt`, a line an instance: mask file, class, score), an NPZ with `masks`
    (n, k) and optional `scores` (k,), `labels` (k,), an NPZ with `objectId` (n,), or a folder that holds such a
    file under the scan's name; n counts the rows of the scan's file, those without depth too. A point under
    several masks belongs to that with the highest score, of equal ones to the first. Masks scored below
    `min_score` and those left without points are reported as skipped.

    Raises ValueError, in one line, when files are missing or malformed or do not speak of the cloud's points.
    """
    file = _of_scan(scan, path)
    bare = replace(cloud, point_labels=None, labels={})
    if file.suffix.lower() == ".npz":
        arrays = _arrays(file)
        if key := next((k for k in PER_POINT if k in arrays and "masks" not in arrays), None):
            _check_count(file, key, arrays[key], cloud)
            return replace(bare, instance=_of_points(cloud, instance_ids(file, arrays[key])))
        masks = _from_arrays(file, arrays, cloud)
    else:
        masks = _from_benchmark(file, cloud)
    masks = [replace(mask, covers=_of_points(cloud, mask.covers)) for mask in masks]
    return _laid(bare, masks, min_score)


def _of_points(cloud: LabeledCloud, values: np.ndarray) -> np.ndarray:
    """Values of the file's rows at those rows that are points: a range camera's file has rows without depth."""
    return values if cloud.rows is None else values[cloud.rows]


def _laid(cloud: LabeledCloud, masks: list[Mask], min_score: float) -> LabeledCloud:
    instance = np.zeros(len(cloud.points), np.int64)
    skipped, chosen = [], []
    for i, mask in enumerate(masks, 1):
        if mask.score >= min_score:
            chosen.append(i)
        else:
            skipped.append(Skipped(what=mask.name, reason=f"score {mask.score:.3g}; needed {min_score:g}"))
    for i in sorted(chosen, key=lambda i: (masks[i - 1].score, -i)):  # the surest last: it has its way
        instance[masks[i - 1].covers] = i
    left = np.bincount(instance, minlength=len(masks) + 1)
    for i in chosen:
        if not left[i]:
            why = "all its points lie under surer masks" if masks[i - 1].covers.any() else "covers no point"
            skipped.append(Skipped(what=masks[i - 1].name, reason=why))
    labels = {i: label for i in chosen if (label := masks[i - 1].label)}
    return replace(cloud, instance=instance, labels=labels, skipped=(*cloud.skipped, *skipped))


def _of_scan(scan: Path, path: Path) -> Path:
    """The masks file itself, or the one of a folder whose name begins the scan's; the longest such name."""
    if not path.exists():
        raise ValueError(f"{path}: no such file or folder of masks")
    if path.is_file():
        return path
    name = scan.stem if scan.is_file() else scan.resolve().name
    files = [f for f in sorted(path.iterdir()) if f.suffix.lower() in (".txt", ".npz") and f.is_file()]
    files = [f for f in files if name == f.stem or name.startswith((f"{f.stem}_", f"{f.stem}."))]
    if not files:
        raise ValueError(f"{path}: no masks of scan {name}; needed {name}.txt or {name}.npz")
    return max(files, key=lambda f: len(f.stem))


def _check_count(file: Path, name: str, values: np.ndarray, cloud: LabeledCloud) -> None:
    if values.shape != (cloud.file_rows,):
        found = len(values) if values.ndim == 1 else values.shape
        raise ValueError(f"{file}: {name} is for {found} points; the scan has {cloud.file_rows}")
    if values.dtype.kind not in "iub":
        raise ValueError(f"{file}: {name} holds {values.dtype}; needed integers")


# --- NPZ --------------------------------------------------------------------------------------------------------


def _arrays(file: Path) -> dict[str, np.ndarray]:
    arrays, has = read_arrays(file, ("masks", "scores", "labels", *PER_POINT))
    if not {"masks", *PER_POINT} & set(arrays):
        raise ValueError(f"{file}: arrays are {has}; needed masks or objectId")
    return arrays


def _from_arrays(file: Path, arrays: dict[str, np.ndarray], cloud: LabeledCloud) -> list[Mask]:
    masks, n = arrays["masks"], cloud.file_rows
    if masks.ndim != 2 or len(masks) != n:
        raise ValueError(f"{file}: masks have shape {masks.shape}; needed ({n}, instances) for this scan")
    if masks.dtype.kind not in "biuf":
        raise ValueError(f"{file}: masks hold {masks.dtype}; needed booleans or numbers")
    count = masks.shape[1]
    scores, labels = arrays.get("scores", np.ones(count)), arrays.get("labels")
    if scores.shape != (count,) or scores.dtype.kind not in "iuf" or not np.isfinite(scores).all():
        raise ValueError(
            f"{file}: scores of shape {scores.shape}, {scores.dtype}; needed {count} finite numbers"
        )
    if labels is not None and (labels.shape != (count,) or labels.dtype.kind not in "iuUS"):
        raise ValueError(
            f"{file}: labels of shape {labels.shape}, {labels.dtype}; needed {count} names or ids"
        )
    names = [None] * count if labels is None else [_text(label) for label in labels]
    return [
        Mask(name=f"mask {k + 1}", covers=masks[:, k] != 0, score=float(scores[k]), label=names[k])
        for k in range(count)
    ]


def _text(label: np.generic) -> str:
    return label.decode("utf-8", "replace") if isinstance(label, bytes) else str(label)


# --- the benchmark's text files ---------------------------------------------------------------------------------


def _from_benchmark(file: Path, cloud: LabeledCloud) -> list[Mask]:
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise ValueError(f"{file}: not a readable text file ({one_line(error)})") from error
    return [_mask(file, i, line, cloud.file_rows) for i, line in enumerate(lines, 1) if line.strip()]


def _mask(file: Path, number: int, line: str, n: int) -> Mask:
    words = line.rsplit(None, 2)
    try:
        name, label, score = words[0].strip(), words[1], float(words[2])
    except (IndexError, ValueError) as error:
        raise ValueError(f"{file}: line {number} is not a mask file, a class and a score") from error
    if not np.isfinite(score):
        raise ValueError(f"{file}: line {number}: score {score}; needed a finite number")
    shown = one_line(ValueError(name))
    if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts or "\0" in name:
        raise ValueError(f"{file}: line {number}: {shown} is not below the folder of this file")
    values = _values(file.parent / name, f"{file}: line {number}: {shown}")
    if values.shape != (n,):
        raise ValueError(f"{file}: line {number}: {shown} has {values.size} numbers; the scan has {n} points")
    return Mask(name=shown, covers=values != 0, score=score, label=one_line(ValueError(label)))


def _values(path: Path, where: str) -> Float[np.ndarray, "n"]:
    try:
        text = path.read_text(encoding="ascii")
        values = np.array(text.split(), np.float64)
    except (OSError, ValueError) as error:
        raise ValueError(f"{where} is not a readable file of numbers ({one_line(error)})") from error
    if not np.isfinite(values).all():
        raise ValueError(f"{where} has numbers that are not finite")
    return values
