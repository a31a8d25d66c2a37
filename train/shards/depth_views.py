"""Depth maps of a shape from all around, back-projected: what partial clouds are drawn from (paper §3.1)."""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from trimesh.ray.ray_pyembree import RayMeshIntersector

from train.shards.view_directions import DISTANCE, HALF_FIELD, view_directions

POINTS_A_VIEW = 512
PIXELS = 64  # a side


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
) -> tuple[Float[np.ndarray, "views n 3"], Float[np.ndarray, "views n 3"]]:
    """Surface points seen from each of `VIEWS` directions, canonical units, and their unit normals, outward.

    Raises ValueError if a view sees less than `fewest_hits`.
    """
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    caster, outward = RayMeshIntersector(mesh), np.asarray(mesh.face_normals)
    views, normals = [], []
    for toward in view_directions():
        hits, hit_faces = view_hits(caster, toward)
        if len(hits) < fewest_hits:
            raise ValueError(f"a view has {len(hits)} hits; needed {fewest_hits}")
        chosen = rng.choice(len(hits), POINTS_A_VIEW, replace=len(hits) < POINTS_A_VIEW)
        views.append(hits[chosen])
        normals.append(outward[hit_faces[chosen]])
    return np.stack(views), np.stack(normals)


def view_hits(
    caster: RayMeshIntersector, toward: Float[np.ndarray, " 3"]
) -> tuple[Float[np.ndarray, "h 3"], Int[np.ndarray, " h"]]:
    """First hits of the pixels' rays of the camera on the side `toward`, and the faces that were hit."""
    rays = pixel_rays(toward)
    eyes = np.tile(DISTANCE * toward, (len(rays), 1))
    found = caster.intersects_location(eyes, rays, multiple_hits=False)
    return np.asarray(found[0]), np.asarray(found[2])


def seen_from(
    caster: RayMeshIntersector, eye: Float[np.ndarray, " 3"], points: Float[np.ndarray, "p 3"]
) -> Bool[np.ndarray, " p"]:
    """Whether surface points are the first thing on the line from `eye`."""
    ray = points - eye
    length = np.linalg.norm(ray, axis=1)
    found = caster.intersects_location(
        np.tile(eye, (len(ray), 1)), ray / length[:, None], multiple_hits=False
    )
    hits, index = np.asarray(found[0]), np.asarray(found[1])
    first = np.full(len(points), np.inf)
    first[index] = np.linalg.norm(hits - eye, axis=1)
    return np.abs(first - length) < 1e-3


def coverage(
    vertices: Float[np.ndarray, "v 3"], faces: np.ndarray, rng: np.random.Generator, count: int = 4000
) -> float:
    """Share of the visible surface that the depth views see.

    Visible is what some of 300 directions around sees, of `count` points spread evenly over the surface.
    """
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    caster = RayMeshIntersector(mesh)
    points = np.asarray(trimesh.sample.sample_surface(mesh, count, seed=int(rng.integers(2**31)))[0])
    by_views, by_any = np.zeros(count, bool), np.zeros(count, bool)
    for toward in view_directions():
        by_views |= seen_from(caster, DISTANCE * toward, points)
    for toward in view_directions(300):
        left = np.flatnonzero(~(by_any | by_views))
        by_any[left] = seen_from(caster, DISTANCE * toward, points[left])
    return float(by_views.sum() / max(1, (by_views | by_any).sum()))
