"""Instances as groups of segments: the annotation that ScanNet, ScanNet++ and 3RScan share.

One file gives every vertex its segment (`segIndices`), another lists groups of segments (`segGroups`: an id, a
label, the segments). Ids come as numbers or as strings; a group may be empty, or named twice.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Integer

from more2_jax.scans.files.json_file import read_json
from more2_jax.scans.files.ply_cloud import PlyCloud
from more2_jax.scans.labeled_cloud import LabeledCloud
from more2_jax.scans.structural_labels import drop_background
from more2_jax.types import Skipped

ID_KEYS = ("objectId", "id")
LARGEST_ID = 2**31 - 1


@dataclass(frozen=True, kw_only=True)
class SegmentGroup:
    """One annotated object; `id` as in the file."""

    id: int
    label: str | None
    segments: Integer[np.ndarray, "s"]


def whole_number(value: Any, where: str) -> int:
    """An id written as 7, "7" or 7.0. ValueError, in one line, for anything else or beyond 31 bits."""
    if isinstance(value, str) and value.strip().lstrip("-").isdecimal() and len(value) < 20:
        value = int(value)
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"{where}: got {str(value)[:40]!r}; needed a whole number")
    if abs(value) > LARGEST_ID:
        raise ValueError(f"{where}: got {value}; needed at most {LARGEST_ID}")
    return value


def whole_numbers(values: Any, where: str) -> Integer[np.ndarray, "n"]:
    """A list of ids as int64; strings are numbers too."""
    if not isinstance(values, list):
        raise ValueError(f"{where}: got {type(values).__name__}; needed a list of whole numbers")
    if not set(map(type, values)) <= {int}:
        values = [whole_number(value, where) for value in values]
    try:
        return np.fromiter(values, np.int64, len(values))
    except OverflowError as error:
        raise ValueError(f"{where}: numbers beyond 63 bits; needed at most {LARGEST_ID}") from error


def read_groups(path: Path, *, segments: bool = True) -> tuple[SegmentGroup, ...]:
    """The groups of an annotation file in its order. ValueError, in one line, on what is missing or malformed.

    `segments=False` reads ids and labels alone (3RScan, whose vertices carry the object).
    """
    content = read_json(path)
    rows = content.get("segGroups") if isinstance(content, dict) else None
    if not isinstance(rows, list):
        raise ValueError(f"{path}: no list 'segGroups'; needed the annotated objects")
    return tuple(_group(f"{path}: segGroups[{i}]", row, segments) for i, row in enumerate(rows))


def _group(where: str, row: Any, with_segments: bool) -> SegmentGroup:
    if not isinstance(row, dict):
        raise ValueError(
            f"{where}: got {type(row).__name__}; needed an object with objectId, label, segments"
        )
    name = next((key for key in ID_KEYS if row.get(key) is not None), None)
    if name is None:
        raise ValueError(f"{where}: no objectId or id; needed one")
    label = row.get("label")
    if label is not None and not isinstance(label, str):
        raise ValueError(f"{where}: label is {str(label)[:40]!r}; needed a string")
    found = whole_numbers(row.get("segments") or [], f"{where}: segments") if with_segments else []
    number = whole_number(row[name], f"{where}: {name}")
    return SegmentGroup(id=number, label=label, segments=np.asarray(found, np.int64))


def read_segment_indices(path: Path, count: int) -> Integer[np.ndarray, "n"]:
    """The segment of every vertex. ValueError, in one line, if there are not `count` of them."""
    content = read_json(path)
    values = content.get("segIndices") if isinstance(content, dict) else None
    indices = whole_numbers(values, f"{path}: segIndices")
    if len(indices) != count:
        raise ValueError(f"{path}: {len(indices)} segIndices; needed {count}, one a vertex of the mesh")
    return indices


def instances_of(
    groups: tuple[SegmentGroup, ...], indices: Integer[np.ndarray, "n"], shift: int
) -> tuple[Integer[np.ndarray, "n"], dict[int, str], tuple[Skipped, ...]]:
    """Instance of every vertex (`id + shift`, 0 outside all groups), their labels, and groups without vertices.

    Where groups share a segment the later in the file has it; groups of one id are one instance, which has
    the first label.
    """
    ids = np.array([group.id + shift for group in groups], np.int64)
    segments = np.concatenate([np.zeros(0, np.int64), *(group.segments for group in groups)])
    owners = np.repeat(ids, [len(group.segments) for group in groups])
    # Of a segment's rows `unique` keeps the first: reversed, the later group's.
    known, rows = np.unique(segments[::-1], return_index=True)
    owner = owners[::-1][rows]
    instance = np.zeros(len(indices), np.int64)
    if len(known):
        at = np.minimum(np.searchsorted(known, indices), len(known) - 1)
        instance = np.where(known[at] == indices, owner[at], 0)
    labels = {
        i: group.label for i, group in zip(ids[::-1].tolist(), groups[::-1], strict=True) if group.label
    }
    empty = sorted(set(ids.tolist()) - set(np.unique(instance).tolist()))
    skipped = tuple(
        Skipped(what=f"instance {i} ({labels.get(i, 'no label')})", reason="no vertices of its own")
        for i in empty
    )
    return instance, labels, skipped


def labeled_by_groups(
    cloud: PlyCloud, groups: tuple[SegmentGroup, ...], indices: Integer[np.ndarray, "n"], shift: int
) -> LabeledCloud:
    """The vertices, each in the instance that its segment belongs to; walls, floors and the like are background."""
    instance, labels, empty = instances_of(groups, indices, shift)
    instance, structural = drop_background(instance, labels)
    return LabeledCloud(
        points=cloud.points,
        instance=instance,
        colors=cloud.colors,
        normals=cloud.normals,
        labels=labels,
        skipped=(*structural, *empty),
        unit="m",
    )


def shift_of(ids: list[int]) -> int:
    """What makes ids positive, so that 0 is background alone: 1 where an object is numbered 0, else 0."""
    if ids and min(ids) < 0:
        raise ValueError(f"object id {min(ids)}; needed 0 or more")
    return int(0 in ids)
