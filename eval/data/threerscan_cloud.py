"""The points of a scan of 3RScan, and the annotated and the predicted masks over these same points.

The published evaluation has points of its own: `<scan>/pointcloud.instances.align.ply`, depth back-projected into the
reference's frame. `pointcloud.labels.npz` and `mask3d.labels.npz` hold one `objectId` for each; predicted ids are
already those of the annotated objects. Without these files, points are the vertices of the annotated mesh.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int

from more2_jax.geometry.poses import Points, Pose, apply_pose
from more2_jax.scans.files.ply_cloud import read_ply
from more2_jax.scans.labeled_cloud import LabeledCloud, ReadOptions
from more2_jax.scans.large_instances import MOST_POINTS, spread
from more2_jax.scans.predicted_masks import lay_masks
from more2_jax.scans.read_scan import read_masked, scan_of
from more2_jax.scans.segment_groups import read_groups
from more2_jax.scans.structural_labels import drop_background
from more2_jax.types import Scan, Skipped

CLOUD, ANNOTATED, PREDICTED = "pointcloud.instances.align.ply", "pointcloud.labels.npz", "mask3d.labels.npz"
FEWEST_POINTS = 1024  # of an instance of the published cloud: the published evaluation knows no smaller one
LEAST_SCORE = 0.5  # of a predicted mask that has a score


def read_scans(folder: Path, T_ref_scan: Pose, *, predicted: bool) -> tuple[Scan, Scan | None]:
    """A scan in its own frame through its annotated masks and, if asked for, through predicted ones.

    Both have the same points, so that masks can be compared. Raises ValueError, in one line, on what is missing or
    damaged, and where masks are not of these points.
    """
    clouds = [_published(folder, T_ref_scan, ANNOTATED)] if is_published(folder, predicted=predicted) else []
    if clouds and predicted:
        clouds.append(_published(folder, T_ref_scan, PREDICTED))
    if not clouds:
        clouds = [read_masked(folder, ReadOptions(), LEAST_SCORE)]
        if predicted:
            masks = ReadOptions(masks=masks_of(folder), masks_needed=False)
            clouds.append(read_masked(folder, masks, LEAST_SCORE))
    rows = few_rows(clouds[0].points, [c.instance for c in clouds if c.instance is not None])
    scans = [_scan(folder, _at(cloud, rows)) for cloud in clouds]
    return scans[0], scans[1] if predicted else None


def _scan(folder: Path, cloud: LabeledCloud) -> Scan:
    """As `read_scan` makes it, but a scan without any instance is one too."""
    if cloud.instance is not None and (cloud.instance <= 0).all():
        return Scan(
            name=folder.name,
            source=str(folder),
            instances=(),
            background=cloud.points,
            skipped=cloud.skipped,
        )
    return scan_of(folder, cloud, "m", 1)


def is_published(folder: Path, *, predicted: bool) -> bool:
    """Whether a scan's points are those of the published evaluation: all files that are asked for lie in its folder."""
    names = (CLOUD, ANNOTATED, PREDICTED) if predicted else (CLOUD, ANNOTATED)
    return all((folder / name).is_file() for name in names)


def masks_of(folder: Path) -> Path:
    """The file of predicted masks over the vertices. Raises ValueError if there is none."""
    files = [folder / PREDICTED, folder / f"{folder.name}.txt", folder / f"{folder.name}.npz"]
    found = next((f for f in files if f.is_file()), None)
    if found is None:
        raise ValueError(f"{folder}: no predicted masks; needed {', '.join(f.name for f in files)}")
    return found


def few_rows(points: Points, labels: Sequence[Int[np.ndarray, " n"]]) -> Int[np.ndarray, " k"]:
    """Rows, ascending, of which no instance has more than `MOST_POINTS` under any of the labels; background stays.

    A scan thins what is larger anyway, but each mask by itself: of two masks of one object little would be common.
    """
    kept = np.ones(len(points), bool)
    for instance in labels:
        for id_ in np.unique(instance[instance > 0]):
            own = np.flatnonzero(kept & (instance == id_))
            if len(own) > MOST_POINTS:
                kept[own] = False
                kept[own[spread(points[own], MOST_POINTS)]] = True
    return np.flatnonzero(kept)


def _published(folder: Path, T_ref_scan: Pose, labels: str) -> LabeledCloud:
    """The published cloud, moved back into the scan's own frame, through one of its files of labels."""
    points = apply_pose(np.linalg.inv(T_ref_scan), read_ply(folder / CLOUD).points)
    cloud = lay_masks(LabeledCloud(points=points, instance=None, unit="m"), folder, folder / labels, 0.0)
    names = {g.id: g.label for g in read_groups(folder / "semseg.v2.json", segments=False) if g.label}
    instance = np.zeros(len(points), np.int64) if cloud.instance is None else cloud.instance
    instance, structural = drop_background(instance, names)
    instance, small = _without_small(instance)
    skipped = (*cloud.skipped, *structural, *small)
    return dataclasses.replace(cloud, instance=instance, labels=names, skipped=skipped)


def _without_small(instance: Int[np.ndarray, " n"]) -> tuple[Int[np.ndarray, " n"], tuple[Skipped, ...]]:
    ids, counts = np.unique(instance[instance > 0], return_counts=True)
    small = {i: n for i, n in zip(ids.tolist(), counts.tolist(), strict=True) if n < FEWEST_POINTS}
    skipped = [
        Skipped(what=f"instance {i}", reason=f"{n} points; needed {FEWEST_POINTS}") for i, n in small.items()
    ]
    return np.where(np.isin(instance, list(small)), 0, instance), tuple(skipped)


def _at(cloud: LabeledCloud, rows: Int[np.ndarray, " k"]) -> LabeledCloud:
    """The cloud with some of its points alone."""
    if len(rows) == len(cloud.points):
        return cloud
    names = ("points", "instance", "colors", "normals", "point_labels")
    by_point = {n: v[rows] for n in names if (v := getattr(cloud, n)) is not None}
    return dataclasses.replace(cloud, **by_point)
