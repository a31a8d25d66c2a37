"""Floor, walls and ceiling of a scan: large planes that nearly nothing lies beyond."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from more2_jax.geometry.segmentation_config import SegmentationConfig

LEVEL = 0.97  # cosine between a floor's normal and z


@dataclass(frozen=True, kw_only=True)
class Plane:
    """`normal · p = offset_m`; the normal points to where the scene lies."""

    normal: Float[np.ndarray, "3"]
    offset_m: float
    area_m2: float  # of the voxels on it
    behind: float  # share of the scene beyond it
    structure: bool  # floor, wall or ceiling: removed


def boundary_planes(
    voxels: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"], config: SegmentationConfig
) -> tuple[tuple[Plane, ...], Bool[np.ndarray, "v"]]:
    """The largest planes one after the other, and the voxels on or beyond those that are structure."""
    rng = np.random.default_rng(config.seed)
    free = np.ones(len(voxels), bool)  # not yet on any plane
    structure = np.zeros(len(voxels), bool)
    planes: list[Plane] = []
    scene_m = extent(voxels)
    for _ in range(config.planes):
        if (found := _largest_plane(voxels, normals, free, config, rng)) is None:
            break
        normal, offset = found
        on = _on_plane(voxels, normals, normal, offset, config)
        area = float((on & free).sum()) * config.voxel_m**2
        if area < config.structure_area_m2:
            break
        height = voxels @ normal - offset
        sides = np.array(
            [(height < -config.plane_distance_m).mean(), (height > config.plane_distance_m).mean()]
        )
        sign = -1.0 if sides[0] > sides[1] else 1.0
        plane = Plane(
            normal=sign * normal,
            offset_m=sign * offset,
            area_m2=area,
            behind=float(sides.min()),
            structure=False,
        )
        wide = extent(voxels[on]) >= config.structure_share * scene_m
        if wide and plane.behind <= config.behind_share and not _before_another(plane, planes, config):
            plane = replace(plane, structure=True)
            structure |= on | (sign * height < -config.plane_distance_m)
        free &= ~on
        planes.append(plane)
    return tuple(planes), structure


def _before_another(plane: Plane, planes: list[Plane], config: SegmentationConfig) -> bool:
    """Whether it faces a floor or wall from nearer than a room is wide: a table top, a cabinet's door."""
    return any(
        p.structure
        and p.normal @ plane.normal < -np.cos(np.deg2rad(config.plane_angle_deg))
        and -plane.offset_m - p.offset_m < config.room_m
        for p in planes
    )


def _largest_plane(
    voxels: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    free: Bool[np.ndarray, "v"],
    config: SegmentationConfig,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "3"], float] | None:
    """RANSAC with one voxel and its normal a try; the best is fitted again to the voxels on it."""
    rows = np.flatnonzero(free)
    if len(rows) * config.voxel_m**2 < config.structure_area_m2:
        return None
    tries = rng.choice(rows, config.plane_tries)
    judges = rng.choice(rows, min(len(rows), 6000), replace=False)
    tried = normals[tries]
    offsets = np.einsum("ti,ti->t", voxels[tries], tried)
    near = np.abs(voxels[judges] @ tried.T - offsets) < config.plane_distance_m
    along = np.abs(normals[judges] @ tried.T) > np.cos(np.deg2rad(config.plane_angle_deg))
    best = int((near & along).sum(axis=0).argmax())
    normal, offset = tried[best], float(offsets[best])
    for _ in range(3):
        on = voxels[_on_plane(voxels, normals, normal, offset, config) & free]
        if len(on) < 3:
            return None
        center = on.mean(axis=0)
        normal = np.linalg.eigh((on - center).T @ (on - center))[1][:, 0]
        offset = float(center @ normal)
    return normal, offset


def _on_plane(
    voxels: np.ndarray, normals: np.ndarray, normal: np.ndarray, offset: float, config: SegmentationConfig
) -> Bool[np.ndarray, "v"]:
    near = np.abs(voxels @ normal - offset) < config.plane_distance_m
    return near & (np.abs(normals @ normal) > np.cos(np.deg2rad(config.plane_angle_deg)))


def words(plane: Plane) -> str:
    normal = ", ".join(f"{c:.2f}" for c in plane.normal + 0.0)
    return f"{plane.area_m2:.1f} m² facing ({normal}) with {100 * plane.behind:.1f} % of the scene behind"


def floor_of(planes: Iterable[Plane]) -> Plane | None:
    """The largest plane that is structure and faces up, where z is up to about 15°."""
    return next((p for p in planes if p.structure and p.normal[2] > LEVEL), None)


def extent(points: Float[np.ndarray, "n 3"]) -> float:
    """Length along the direction of greatest spread, in any frame the same."""
    if not len(points):
        return 0.0
    centered = points - points.mean(axis=0)
    return float(np.ptp(centered @ np.linalg.eigh(centered.T @ centered)[1][:, -1]))
