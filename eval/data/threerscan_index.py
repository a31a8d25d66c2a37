"""`3RScan.json` (paper §4): which scans show the same place, what moved between them, and how.

The file's matrices are 16 numbers, column by column; here they are row-major, float64, meters. Two of its
directions differ, and this module turns both the same way:

- `transform` of a rescan takes points of the rescan to the reference: kept as `T_ref_rescan`;
- `transform` of a moved object takes its points in the reference to where it stands in the rescan, in the
  rescan's own frame: inverted to `MovedObject.T_ref_rescan`, rescan to reference again.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from more2_jax.scans.files.json_file import read_json
from more2_jax.scans.files.rgbd_sequence import is_rigid
from more2_jax.scans.segment_groups import whole_number
from more2_jax.types import Skipped

# The movable categories of the benchmark (paper §4).
CATEGORIES = (
    *(
        "armchair",
        "bed",
        "bench",
        "chair",
        "coffee table",
        "computer desk",
        "couch",
        "couch table",
        "cushion",
    ),
    *(
        "desk",
        "dining chair",
        "dining table",
        "footstool",
        "ottoman",
        "pillow",
        "rocking chair",
        "round table",
    ),
    *("side table", "sofa", "sofa chair", "stand", "table", "trash can"),
)
SPLITS = ("train", "validation", "test")
SYMMETRY_FOLDS = {0: 1, 1: 2, 2: 4}  # class in the file → turns about the vertical that look alike
MM_FROM = 100.0  # a shift beyond this is no room in meters: the first release had millimeters


@dataclass(frozen=True, kw_only=True)
class MovedObject:
    """An object that moved as a rigid body; `T_ref_rescan` takes its points in the rescan to its reference pose."""

    instance_ref: int
    instance_rescan: int
    T_ref_rescan: Float[np.ndarray, "4 4"]
    symmetry: int  # the file's class; 0: none. Turns: SYMMETRY_FOLDS


@dataclass(frozen=True, kw_only=True)
class Ambiguity:
    """Two objects of the reference that look the same; takes points of `source` onto `target`, reference frame."""

    source: int
    target: int
    T_target_source: Float[np.ndarray, "4 4"]


@dataclass(frozen=True, kw_only=True)
class Rescan:
    """A later scan of the place."""

    id: str
    T_ref_rescan: Float[np.ndarray, "4 4"]  # of what did not move
    moved: tuple[MovedObject, ...] = ()
    nonrigid: tuple[int, ...] = ()  # instances of the reference that changed shape
    removed: tuple[int, ...] = ()  # instances of the reference that are gone

    def instance_in_reference(self, instance: int) -> int:
        """The same object's id in the reference: as the moved objects say, else unchanged."""
        return next((m.instance_ref for m in self.moved if m.instance_rescan == instance), instance)

    def pose_of(self, instance: int) -> Float[np.ndarray, "4 4"]:
        """Takes the rescan's points of this instance to where the object was in the reference."""
        return next((m.T_ref_rescan for m in self.moved if m.instance_rescan == instance), self.T_ref_rescan)


@dataclass(frozen=True, kw_only=True)
class Place:
    """A reference scan and the rescans that can be used."""

    reference: str
    split: str
    rescans: tuple[Rescan, ...]
    ambiguities: tuple[Ambiguity, ...] = ()

    def interchangeable(self, instance: int) -> dict[int, Float[np.ndarray, "4 4"]]:
        """Objects of the reference that look like this one → the pose from it onto them, itself included.

        Follows chains: if 1 looks like 2 and 2 like 3, then 1 looks like 3; pairs hold both ways.
        """
        found, queue = {instance: np.eye(4)}, deque([instance])
        while queue:
            here = queue.popleft()
            for a in self.ambiguities:
                if a.source == here and a.target not in found:
                    found[a.target] = a.T_target_source @ found[here]
                    queue.append(a.target)
                elif a.target == here and a.source not in found:
                    found[a.source] = np.linalg.inv(a.T_target_source) @ found[here]
                    queue.append(a.source)
        return found


@dataclass(frozen=True, kw_only=True)
class ScanIndex:
    """All places, and the scans that the file names but that cannot be used."""

    places: tuple[Place, ...]
    skipped: tuple[Skipped, ...] = field(default=())


def read_index(path: str | Path, scans: str | Path | None = None, split: str | None = None) -> ScanIndex:
    """Reads `3RScan.json`; `split` keeps one of train, validation, test.

    `scans` is the folder with a folder a scan; rescans that are not in it, or have no transform (the hidden test
    set), are left out and reported; a place without its reference is left out whole. Raises ValueError, in one
    line, when the file is missing, damaged, or a matrix is no rigid motion.
    """
    path = Path(path)
    if split is not None and split not in SPLITS:
        raise ValueError(f"split {split!r}; needed one of {', '.join(SPLITS)}")
    rows = read_json(path)
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ValueError(f"{path}: needed a list of places, each with reference, type and scans")
    scale = _translation_scale(rows)
    places, skipped = [], []
    for i, row in enumerate(rows):
        place, left_out = _place(f"{path}: place {i}", row, scale, None if scans is None else Path(scans))
        if split is None or row.get("type") == split:
            skipped += left_out
            places += [place] if place else []
    return ScanIndex(places=tuple(places), skipped=tuple(skipped))


def _place(where: str, row: dict, scale: float, scans: Path | None) -> tuple[Place | None, list[Skipped]]:
    reference, split = _text(row, "reference", where), _text(row, "type", where)
    if split not in SPLITS:
        raise ValueError(f"{where}: type {split!r}; needed one of {', '.join(SPLITS)}")
    if scans is not None and not _on_disk(scans, reference):
        return None, [Skipped(what=f"reference {reference}", reason="no such folder: its place is left out")]
    rescans, skipped = [], []
    for i, scan in enumerate(_rows(row, "scans", where)):
        name = _text(scan, "reference", f"{where}: scan {i}")
        if scans is not None and not _on_disk(scans, name):
            skipped.append(Skipped(what=f"rescan {name}", reason="no such folder"))
        elif not scan.get("transform"):
            skipped.append(Skipped(what=f"rescan {name}", reason="no transform to its reference"))
        else:
            rescans.append(_rescan(f"{where}: rescan {name}", name, scan, scale))
    chains = row.get("ambiguity") or []
    if not isinstance(chains, list):
        raise ValueError(f"{where}: ambiguity is no list")
    flat = [pair for chain in chains for pair in (chain if isinstance(chain, list) else [chain])]
    pairs = tuple(_ambiguity(f"{where}: ambiguity {i}", pair, scale) for i, pair in enumerate(flat))
    return Place(reference=reference, split=split, rescans=tuple(rescans), ambiguities=pairs), skipped


def _on_disk(scans: Path, name: str) -> bool:
    return Path(name).name == name and (scans / name).is_dir()


def _rescan(where: str, name: str, scan: dict, scale: float) -> Rescan:
    moved = []
    for i, row in enumerate(_rows(scan, "rigid", where)):
        at = f"{where}: rigid {i}"
        moved.append(
            MovedObject(
                instance_ref=whole_number(row.get("instance_reference"), f"{at}: instance_reference"),
                instance_rescan=whole_number(row.get("instance_rescan"), f"{at}: instance_rescan"),
                T_ref_rescan=np.linalg.inv(_matrix(row, at, scale)),
                symmetry=whole_number(row.get("symmetry", 0), f"{at}: symmetry"),
            )
        )
    return Rescan(
        id=name,
        T_ref_rescan=_matrix(scan, where, scale),
        moved=tuple(moved),
        nonrigid=_instances(scan, "nonrigid", where),
        removed=_instances(scan, "removed", where),
    )


def _ambiguity(where: str, row: Any, scale: float) -> Ambiguity:
    if not isinstance(row, dict):
        raise ValueError(
            f"{where}: got {type(row).__name__}; needed instance_source, instance_target, transform"
        )
    source, target = (
        whole_number(row.get(key), f"{where}: {key}") for key in ("instance_source", "instance_target")
    )
    return Ambiguity(source=source, target=target, T_target_source=_matrix(row, where, scale))


def _instances(scan: dict, key: str, where: str) -> tuple[int, ...]:
    """Ids, bare or as records with the id in the reference."""
    values = scan.get(key) or []
    if not isinstance(values, list):
        raise ValueError(f"{where}: {key} is no list")
    ids = (
        v.get("instance_reference", v.get("instance_rescan")) if isinstance(v, dict) else v for v in values
    )
    return tuple(dict.fromkeys(whole_number(i, f"{where}: {key}") for i in ids))


def _text(row: dict, key: str, where: str) -> str:
    if not isinstance(row.get(key), str) or not row[key]:
        raise ValueError(f"{where}: no {key}; needed a string")
    return row[key]


def _rows(row: dict, key: str, where: str) -> list[dict]:
    values = row.get(key) or []
    if not isinstance(values, list) or not all(isinstance(v, dict) for v in values):
        raise ValueError(f"{where}: {key} is no list of records")
    return values


def _matrix(row: dict, where: str, scale: float) -> Float[np.ndarray, "4 4"]:
    """Row-major from the file's columns; `scale` makes the shift meters."""
    numbers = _sixteen(row.get("transform"))
    if numbers is None:
        raise ValueError(f"{where}: transform is not 16 numbers, column by column")
    T = numbers.reshape(4, 4).T.copy()
    T[:3, 3] *= scale
    if not is_rigid(T):
        raise ValueError(f"{where}: transform is no rigid motion")
    return T


def _sixteen(values: Any) -> Float[np.ndarray, "16"] | None:
    if not isinstance(values, list) or len(values) != 16:
        return None
    if not all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < 1e9 for v in values):
        return None
    return np.array(values, np.float64)


def _translation_scale(rows: list[dict]) -> float:
    """Meters in a unit of the file's shifts: releases differ, within a file they do not."""
    scans = [scan for row in rows if isinstance(row.get("scans"), list) for scan in row["scans"]]
    found = (_sixteen(scan.get("transform")) for scan in scans if isinstance(scan, dict))
    largest = max(
        (float(np.abs(numbers[12:15]).max()) for numbers in found if numbers is not None), default=0.0
    )
    return 0.001 if largest > MM_FROM else 1.0
