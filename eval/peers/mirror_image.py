"""What was not seen as the mirror image of what was: the plain way to complete furniture.

The plane is found by registration: an image in a plane through the cloud is aligned with the cloud itself by ICP
(Cicconet et al., Finding mirror symmetry via registration, 2017), from planes across the cloud's principal axes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from eval.harness.extra import library
from eval.peers.features import diagonal, open3d_cloud
from more2_jax.geometry.poses import Points, apply_pose

VOXEL = 0.02  # of the diagonal
REACH = 0.08  # of the diagonal: farther pairs are none of ICP's
FITS = 0.02  # of the diagonal: an image's point that lies so near the cloud agrees with it
LEAST_FIT = 0.8  # share of the image that must agree: the other side of a partial cloud agrees with nothing
ACROSS = (0.35, 0.5, 0.65)  # of the extent along an axis: where planes across it start


def with_mirror_image(points: Points) -> Points:
    """The points and their mirror image; the points alone where no image agrees with them.

    Meters, any frame. Of the images that agree the one is taken that adds most: a board is its own image too.
    """
    unit, center = diagonal(points), points.mean(axis=0)
    own = (points - center) / unit
    agreeing = [found for found in images(own) if found[0] >= LEAST_FIT]
    if not agreeing:
        return points
    _, image = min(agreeing, key=lambda found: found[0])
    return np.concatenate([points, image * unit + center])


def images(points: Points) -> list[tuple[float, Points]]:
    """Of every start: the share of its image that agrees with the cloud, and the image."""
    cloud = open3d_cloud(points).voxel_down_sample(VOXEL)
    axes = np.linalg.svd(np.asarray(cloud.points), full_matrices=False)[2]
    return [aligned_image(cloud, points, axis, share) for axis in axes for share in ACROSS]


def aligned_image(
    cloud: Any, points: Points, axis: Float[np.ndarray, "3"], share: float
) -> tuple[float, Points]:
    """The image in a plane across `axis`, aligned with the cloud by ICP."""
    o3d = library("open3d")
    along = points @ axis
    offset = along.min() + share * np.ptp(along)
    image = open3d_cloud(reflected(np.asarray(cloud.points), axis, offset))
    T = o3d.pipelines.registration.registration_icp(image, cloud, REACH).transformation
    image.transform(T)
    fit = float((np.asarray(image.compute_point_cloud_distance(cloud)) < FITS).mean())
    return fit, apply_pose(T, reflected(points, axis, offset))


def reflected(points: Points, axis: Float[np.ndarray, "3"], offset: float) -> Points:
    """Points mirrored in the plane ⟨axis, x⟩ = offset; `axis` of unit length."""
    return points - 2 * (points @ axis - offset)[:, None] * axis
