"""A PLY whose vertices carry an integer property that names the instance."""

from __future__ import annotations

from pathlib import Path

from more2_jax.scans.files.ply_cloud import COLOR_PROPERTIES, NORMAL_PROPERTIES, read_ply
from more2_jax.scans.instance_property import instance_of
from more2_jax.scans.labeled_cloud import LabeledCloud, ReadOptions


def recognizes(path: Path) -> bool:
    """Whether this is a PLY file, by its suffix."""
    return path.is_file() and path.suffix.lower() == ".ply"


def read(path: Path, options: ReadOptions) -> LabeledCloud:
    cloud = read_ply(path)
    others = (*COLOR_PROPERTIES, *NORMAL_PROPERTIES)
    name, instance = instance_of(path, cloud.properties, others, options, "vertex property") or ("", None)
    labels = cloud.properties.get("label") if name != "label" else None
    return LabeledCloud(
        points=cloud.points,
        instance=instance,
        colors=cloud.colors,
        normals=cloud.normals,
        point_labels=labels if labels is not None and labels.dtype.kind in "iu" else None,
    )
