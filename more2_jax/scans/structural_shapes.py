"""Floors, walls and ceilings that have a mask of their own and no label: told by their shape.

Annotated scans number every surface. Where labels are missing, a floor would be one more object, and the scan would
have no background to be leveled by.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Integer

from more2_jax.geometry.boundary_planes import Plane, boundary_planes
from more2_jax.geometry.segmentation_config import SegmentationConfig
from more2_jax.geometry.voxels import LARGEST_GRID, voxel_means, voxel_normals
from more2_jax.types import Skipped

# Of an instance: as long as this share of the scan, and with so many of its voxels on floors and walls.
LEAST_LENGTH, LEAST_SHARE = 0.4, 0.7
FEWEST = 3  # masks in a scan: of one or two things alone nothing is the room
REASON = "background: a floor, wall or ceiling by its shape"

Points = Float[np.ndarray, "n 3"]
Ids = Integer[np.ndarray, "n"]


def drop_structure(points: Points, instance: Ids, labels: dict[int, str]) -> tuple[Ids, tuple[Skipped, ...]]:
    """Instances with floors, walls and ceilings set to 0, and one line on each; those with a name stay. Meters.

    What is dropped is as long as much of the scan, lies on planes that bound it, and has more of one of these planes
    than the background or any other instance has: pictures, doors and rugs stay.
    """
    long = long_instances(points, instance, labels)
    if not long or float(np.ptp(points, axis=0).max()) > SegmentationConfig().voxel_m * LARGEST_GRID:
        return instance, ()
    dropped = [i for i in structural(points, instance) if i in long]
    said = tuple(Skipped(what=f"instance {i}", reason=REASON) for i in dropped)
    return np.where(np.isin(instance, dropped), 0, instance), said


def warning(dropped: tuple[Skipped, ...]) -> tuple[str, ...]:
    """What to say of those that were dropped, if any."""
    if not dropped:
        return ()
    which = ", ".join(s.what for s in dropped)
    return (f"taken for floor, wall or ceiling by shape: {which}; a label keeps what is none",)


def long_instances(points: Points, instance: Ids, labels: dict[int, str]) -> set[int]:
    """Instances without a name that may be a floor or wall, by the diagonals of their boxes."""
    order = np.argsort(instance, kind="stable")
    ids, starts = np.unique(instance[order], return_index=True)
    if (ids > 0).sum() < FEWEST:
        return set()
    low, high = (reach.reduceat(points[order], starts) for reach in (np.minimum, np.maximum))
    length = np.linalg.norm(high - low, axis=1)
    least = LEAST_LENGTH * np.linalg.norm(np.ptp(points, axis=0))
    return {
        i
        for i, m in zip(ids.tolist(), length, strict=True)
        if i > 0 and m >= least and not named(labels.get(i))
    }


def named(label: str | None) -> bool:
    """Whether a label says what a thing is; a number of a class does not."""
    return bool(label) and not label.lstrip("-").isdigit()


def structural(points: Points, instance: Ids) -> list[int]:
    """Instances that lie on floors and walls, each having more of one of them than any other or the background."""
    config = SegmentationConfig()
    voxels, voxel_of = voxel_means(points, config.voxel_m)
    ids, which = np.unique(np.maximum(instance, 0), return_inverse=True)
    owner = np.zeros(len(voxels), np.int64)
    owner[voxel_of] = which  # of several in a voxel, one
    planes, _ = boundary_planes(voxels, voxel_normals(voxels, config.normal_neighbors), config)
    on = [on_plane(voxels, p, config) for p in planes if p.structure]
    if not on:
        return []
    most = {int(np.bincount(owner[rows]).argmax()) for rows in on}
    share = np.bincount(owner, np.any(on, axis=0)) / np.maximum(np.bincount(owner), 1)
    return [int(ids[n]) for n in sorted(most) if ids[n] > 0 and share[n] >= LEAST_SHARE]


def on_plane(voxels: Points, plane: Plane, config: SegmentationConfig) -> Bool[np.ndarray, " n"]:
    """The voxels that lie on a plane."""
    return np.abs(voxels @ plane.normal - plane.offset_m) < config.plane_distance_m
