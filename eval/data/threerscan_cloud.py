"""A scan of 3RScan as the published evaluation reads it: its own back-projected cloud, and files of labels a point.

`<scan>/pointcloud.instances.align.ply` is in the reference's frame; `pointcloud.labels.npz` and `mask3d.labels.npz`
hold one `objectId` for each of its points. Predicted ids are already those of the annotated objects.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from more2_jax.geometry.poses import Pose, apply_pose
from more2_jax.scans.files.ply_cloud import read_ply
from more2_jax.scans.labeled_cloud import LabeledCloud
from more2_jax.scans.predicted_masks import lay_masks
from more2_jax.scans.read_scan import scan_of
from more2_jax.scans.segment_groups import read_groups
from more2_jax.scans.structural_labels import drop_background
from more2_jax.types import Scan

CLOUD, ANNOTATED, PREDICTED = "pointcloud.instances.align.ply", "pointcloud.labels.npz", "mask3d.labels.npz"


def has_published_cloud(folder: Path) -> bool:
    """Whether the published evaluation's files lie in a scan's folder."""
    return (folder / CLOUD).is_file() and (folder / ANNOTATED).is_file()


def read_published(folder: Path, T_ref_scan: Pose, labels: str) -> Scan:
    """The cloud, moved back into the scan's own frame, through one of its files of labels.

    Raises ValueError, in one line, on what is missing or damaged, and where labels are not of this cloud.
    """
    points = apply_pose(np.linalg.inv(T_ref_scan), read_ply(folder / CLOUD).points)
    cloud = lay_masks(LabeledCloud(points=points, instance=None, unit="m"), folder, folder / labels, 0.0)
    names = {g.id: g.label for g in read_groups(folder / "semseg.v2.json", segments=False) if g.label}
    instance = np.zeros(len(points), np.int64) if cloud.instance is None else cloud.instance
    instance, skipped = drop_background(instance, names)
    cloud = dataclasses.replace(cloud, instance=instance, labels=names, skipped=(*cloud.skipped, *skipped))
    return scan_of(folder, cloud, "m", 1)
