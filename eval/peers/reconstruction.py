"""What one would make a surface of an object's points with instead: Poisson, ball pivoting, alpha shapes (Open3D).

Each takes accumulated points (meters) and returns a mesh in their frame, or None where it finds no triangle. Only
the mirror image completes what was not seen.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from eval.harness.extra import library
from eval.peers.features import diagonal, open3d_cloud
from eval.peers.mirror_image import with_mirror_image
from more2_jax.geometry.poses import Points
from more2_jax.types import Mesh

Surfacer = Callable[[Points], Mesh | None]

VOXEL = 0.008  # of the diagonal
CROP = 0.02  # a Poisson surface farther than this from the points was not seen
ALPHA = 0.03
RADII = (1.5, 3.0, 6.0)  # of the mean spacing: balls
DEPTH = 7  # of Poisson's octree: cells of 0.8 % of the cube's edge


def prepared(points: Points) -> tuple[Any, float, Float[np.ndarray, "3"]]:
    """The thinned cloud of unit diagonal with outward normals, its scale and its center."""
    o3d = library("open3d")
    unit, center = diagonal(points), points.mean(axis=0)
    cloud = open3d_cloud((points - center) / unit).voxel_down_sample(VOXEL)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(0.04, 30))
    if len(cloud.points) > 20:
        cloud.orient_normals_consistent_tangent_plane(12)
        outward = np.sum(np.asarray(cloud.normals) * np.asarray(cloud.points), axis=1)
        if outward.mean() < 0:
            cloud.normals = o3d.utility.Vector3dVector(-np.asarray(cloud.normals))
    return cloud, unit, center


def poisson(points: Points) -> Mesh | None:
    """Screened Poisson, cropped to what lies near a point."""
    cloud, unit, center = prepared(points)
    mesh, _ = library("open3d").geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=DEPTH, n_threads=1
    )
    if not len(mesh.vertices):
        return None
    far = KDTree(np.asarray(cloud.points)).query(np.asarray(mesh.vertices))[0] > CROP
    mesh.remove_vertices_by_mask(far)
    return in_meters(mesh, unit, center)


def ball_pivoting(points: Points) -> Mesh | None:
    """Ball pivoting with three radii."""
    o3d = library("open3d")
    cloud, unit, center = prepared(points)
    spacing = float(np.mean(cloud.compute_nearest_neighbor_distance()))
    radii = o3d.utility.DoubleVector([r * spacing for r in RADII])
    return in_meters(
        o3d.geometry.TriangleMesh.create_from_point_cloud_ball_pivoting(cloud, radii), unit, center
    )


def alpha_shape(points: Points) -> Mesh | None:
    """The alpha shape at 3 % of the diagonal."""
    cloud, unit, center = prepared(points)
    return in_meters(
        library("open3d").geometry.TriangleMesh.create_from_point_cloud_alpha_shape(cloud, ALPHA),
        unit,
        center,
    )


def mirrored(points: Points) -> Mesh | None:
    """Ball pivoting of the points and their mirror image: completion without learning."""
    return ball_pivoting(with_mirror_image(points))


def in_meters(mesh: Any, unit: float, center: Float[np.ndarray, "3"]) -> Mesh | None:
    """The mesh back in the points' frame; None without a triangle."""
    faces = np.asarray(mesh.triangles)
    if not len(faces):
        return None
    return Mesh(vertices=np.asarray(mesh.vertices) * unit + center, faces=faces.astype(np.int64))


SURFACERS: dict[str, Surfacer] = {
    "screened Poisson, cropped": poisson,
    "ball pivoting": ball_pivoting,
    "alpha shape": alpha_shape,
    "mirror image + ball pivoting": mirrored,
}
