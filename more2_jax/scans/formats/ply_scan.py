"""A PLY whose vertices carry an integer property that names the instance."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from more2_jax.scans.files.ply_cloud import INSTANCE_PROPERTIES, PlyCloud, read_ply
from more2_jax.scans.labeled_cloud import CUT_WITHOUT, LabeledCloud, ReadOptions


def recognizes(path: Path) -> bool:
    """Whether this is a PLY file, by its suffix."""
    return path.is_file() and path.suffix.lower() == ".ply"


def read(path: Path, options: ReadOptions) -> LabeledCloud:
    cloud = read_ply(path)
    name = _instance_property(path, cloud, options)
    labels = cloud.properties.get("label") if name != "label" else None
    return LabeledCloud(
        points=cloud.points,
        instance=None if name is None else cloud.properties[name].astype(np.int64),
        colors=cloud.colors,
        normals=cloud.normals,
        point_labels=labels if labels is not None and labels.dtype.kind in "iu" else None,
    )


def _instance_property(path: Path, cloud: PlyCloud, options: ReadOptions) -> str | None:
    asked, integers = options.instance_property, cloud.integer_properties
    wanted = INSTANCE_PROPERTIES if asked is None else (asked,)
    for name in wanted:
        if name in integers:
            return name
    if asked is None and not options.masks_needed:
        return None
    has = f"integer properties are {', '.join(integers)}" if integers else "it has no integer property"
    raise ValueError(
        f"{path}: no integer vertex property {' or '.join(wanted)} names the instance; {has}"
        f" (choose one with --instance-property, or cut the scan without: {CUT_WITHOUT})"
    )
