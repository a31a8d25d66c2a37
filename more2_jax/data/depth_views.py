"""Depth maps of a shape from all around, back-projected: what partial clouds are drawn from (METHOD 2)."""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.ray.ray_pyembree import RayMeshIntersector

VIEWS = 24
POINTS_A_VIEW = 384
PIXELS = 64  # a side
DISTANCE = 1.6  # of the camera from the centre, canonical units
HALF_FIELD = 0.42  # tangent of half the field of view: the whole unit shape is seen


def view_directions(count: int = VIEWS) -> Float[np.ndarray, "count 3"]:
    """Unit directions spread evenly over the sphere (a Fibonacci spiral)."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = np.pi * (1 + 5**0.5) * index
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)


def pixel_rays(toward: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "r 3"]:
    """Unit directions of the pixels' rays of a camera on the side `toward`, looking at the origin."""
    up = np.array([0.0, 0, 1]) if abs(toward[2]) < 0.95 else np.array([1.0, 0, 0])
    right = np.cross(toward, up)
    right /= np.linalg.norm(right)
    down = np.cross(right, toward)
    span = np.linspace(-HALF_FIELD, HALF_FIELD, PIXELS)
    x, y = np.meshgrid(span, span)
    rays = (-toward + x[..., None] * right + y[..., None] * down).reshape(-1, 3)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def depth_views(
    vertices: Float[np.ndarray, "v 3"], faces: np.ndarray, rng: np.random.Generator, fewest_hits: int = 32
) -> Float[np.ndarray, "views n 3"]:
    """Surface points seen from each of `VIEWS` directions, canonical units.

    Raises ValueError if a view sees less than `fewest_hits`.
    """
    caster = RayMeshIntersector(trimesh.Trimesh(vertices, faces, process=False))
    views = []
    for toward in view_directions():
        rays = pixel_rays(toward)
        eyes = np.tile(DISTANCE * toward, (len(rays), 1))
        hits, _, _ = caster.intersects_location(eyes, rays, multiple_hits=False)
        if len(hits) < fewest_hits:
            raise ValueError(f"a view has {len(hits)} hits; needed {fewest_hits}")
        views.append(hits[rng.choice(len(hits), POINTS_A_VIEW, replace=len(hits) < POINTS_A_VIEW)])
    return np.stack(views)
