"""Point features of objects: FPFH on a cloud of unit diagonal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from eval.harness.extra import library
from more2_jax.geometry.poses import Points

VOXEL = 0.02  # of the diagonal
NORMAL_RADIUS, FEATURE_RADIUS = 2.5 * VOXEL, 5 * VOXEL


@dataclass(frozen=True, kw_only=True)
class Featured:
    """A thinned cloud with normals, and a feature a point; centered, in units of `diagonal`."""

    cloud: Any  # open3d.geometry.PointCloud
    feature: Any  # open3d.pipelines.registration.Feature


def diagonal(points: Points) -> float:
    """Of the box that holds nearly all points; never zero."""
    return max(float(np.linalg.norm(np.ptp(points, axis=0))), 1e-9)


def open3d_cloud(points: Points) -> Any:
    """The points for Open3D."""
    o3d = library("open3d")
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.ascontiguousarray(points, np.float64)))


def featured(points: Points, center: Float[np.ndarray, "3"], unit: float) -> Featured:
    """FPFH of every thinned point; normals point away from the center, as no camera is known."""
    o3d = library("open3d")
    cloud = open3d_cloud((points - center) / unit).voxel_down_sample(VOXEL)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(NORMAL_RADIUS, 30))
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    cloud.normals = o3d.utility.Vector3dVector(-np.asarray(cloud.normals))
    near = o3d.geometry.KDTreeSearchParamHybrid(FEATURE_RADIUS, 100)
    return Featured(cloud=cloud, feature=o3d.pipelines.registration.compute_fpfh_feature(cloud, near))


def fpfh(points: Points) -> Float[np.ndarray, "n 33"]:
    """Features of one cloud alone."""
    return np.asarray(featured(points, points.mean(axis=0), diagonal(points)).feature.data).T
