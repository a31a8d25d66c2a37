"""Scans of one room read together: those without instances are cut by what changed between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from more2_jax.scans.labeled_cloud import LabeledCloud, ReadOptions
from more2_jax.scans.normal_sides import outward
from more2_jax.scans.read_scan import UNITS_M, check_points, check_told, read_masked, scan_of
from more2_jax.scans.seen_empty import UnlabeledScan
from more2_jax.scans.temporal_segmentation import TemporalSegmentation, segment_changes
from more2_jax.types import Scan

MASKS_ARE_BETTER = (
    "instances are found without a network, by what changed between the scans: what stayed and touches is one. Masks"
    " from a network are better: pass Mask3D's output with --masks, or name an instance property with"
    " --instance-property"
)
NOT_USED = "the scan has instance masks, so --segment changes is not used"


@dataclass(frozen=True, kw_only=True)
class _File:
    """One scan as it was read."""

    path: Path
    cloud: LabeledCloud
    unit: str

    def unlabeled(self) -> UnlabeledScan:
        """Its points in meters, whatever instances they have."""
        sensors = np.zeros((0, 3)) if self.cloud.sensors is None else self.cloud.sensors
        normals = self.cloud.normals
        if normals is not None:
            background = np.zeros(len(normals), np.int64)
            normals, _ = outward(self.cloud.points, normals, background, sensors)
        scale = UNITS_M[self.cloud.unit or self.unit]
        return UnlabeledScan(points=self.cloud.points * scale, normals=normals, sensors=sensors * scale)


def read_changed_scans(
    paths: Sequence[str | Path],
    *,
    earlier: Sequence[str | Path] = (),
    masks: Sequence[str | Path | None] = (),
    instance_property: str | None = None,
    unit: str = "m",
    min_points: int = 64,
    min_score: float = 0.5,
    depth_frames: bool = False,
    up: str = "z",
) -> tuple[Scan, ...]:
    """Scans of one room, without instances, cut by what changed between them (`segment_changes`).

    `earlier` are scans of the room that are only compared with. `masks` are none, or one a path (None: that scan has
    none); scans that have instances keep them. The rest is as in `read_scan`: meters, each in its own frame.
    One that fits no other is cut alone, and its warnings say so. Raises ValueError, in one line, for fewer than two
    scans in all, where no instance is left, and for what `read_scan` refuses.
    """
    check_told(unit, up)
    every = [Path(p) for p in (*earlier, *paths)]
    if len(every) < 2 or len(masks) not in (0, len(paths)):
        raise ValueError(
            f"{len(every)} scans, {len(masks)} masks; needed two scans or more, for changes are between scans, and no"
            " masks or one a scan; --segment geometric cuts one scan alone"
        )
    beside = [None] * len(earlier) + [None if m is None else Path(m) for m in masks or [None] * len(paths)]
    told = ReadOptions(
        instance_property=instance_property, masks_needed=False, depth_frames=depth_frames, up=up
    )
    files = []
    for path, mask in zip(every, beside, strict=True):
        options = replace(told, masks=mask)
        cloud = read_masked(path, options, min_score)
        check_points(path, cloud.points)
        files.append(_File(path=path, cloud=cloud, unit=unit))
    return tuple(
        scan_of(f.path, cloud, unit, min_points)
        for f, cloud in zip(files[len(earlier) :], _with_instances(files)[len(earlier) :], strict=True)
    )


def _with_instances(files: Sequence[_File]) -> list[LabeledCloud]:
    """The clouds, each with the instances that it had, or those found."""
    if all(f.cloud.instance is not None for f in files):
        return [_kept(f.cloud) for f in files]
    try:
        found = segment_changes([f.unlabeled() for f in files])
    except ValueError as error:
        names = ", ".join(str(f.path) for f in files)
        raise ValueError(f"{names}: {error}; or --segment geometric, which cuts each alone") from error
    return [
        _cut(f, s) if f.cloud.instance is None else _kept(f.cloud) for f, s in zip(files, found, strict=True)
    ]


def _kept(cloud: LabeledCloud) -> LabeledCloud:
    return replace(cloud, warnings=(*cloud.warnings, NOT_USED))


def _cut(file: _File, found: TemporalSegmentation) -> LabeledCloud:
    """The cloud with the instances found, and what was done in words."""
    if not found.instance.any():
        raise ValueError(f"{file.path}: no instances left after segmentation; {'; '.join(found.sentences())}")
    return replace(
        file.cloud,
        instance=found.instance,
        skipped=(*file.cloud.skipped, *found.skipped),
        warnings=(*file.cloud.warnings, MASKS_ARE_BETTER, *found.sentences()),
    )
