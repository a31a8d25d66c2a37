"""From a source mesh to what training needs of it: solid, depth views, signed distances (paper §3.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import point_cloud_utils as pcu
from jaxtyping import Float, Int

from train.furniture.closed_solids import canonical, solidify
from train.furniture.source_mesh import SourceMesh, check_mesh
from train.shards.depth_views import coverage, depth_views
from train.shards.settings import NORMAL_STEPS
from train.shards.signed_distance import BOX, QUERIES, is_inside, signed_distances

FINGERPRINT_SIDE = 8  # of the grid of distances by which near-duplicates are found


@dataclass(frozen=True, kw_only=True)
class Shape:
    """A training shape: closed, centered, longest edge 0.9 (canonical units)."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    views: Float[np.ndarray, "views n 3"]  # float16, back-projected depth
    normals: Int[
        np.ndarray, "views n 3"
    ]  # int8: outward unit normals there times `NORMAL_STEPS`; 0: not known
    sdf_uniform: Float[np.ndarray, "q 4"]  # float16: x y z and signed distance, negative inside
    sdf_near: Float[np.ndarray, "q 4"]
    fingerprint: Float[np.ndarray, "8 8 8"]  # float16 signed distances on a grid
    meta: dict[str, Any]  # name, category, source, split, license, hash, method, coverage, …


def make_shape(mesh: SourceMesh, queries: int = QUERIES) -> Shape:
    """The training shape of a mesh; it depends on the mesh and its name alone.

    Raises ValueError, with the reason, for a mesh that cannot be used.
    """
    rng = np.random.default_rng(mesh.digest % 2**32)
    check_mesh(mesh)
    used = mesh.vertices[np.unique(mesh.faces)]
    if not np.isfinite(used).all():
        raise ValueError("vertices that are not finite; needed numbers")
    solid = solidify(mesh.vertices, mesh.faces)
    vertices, scale = canonical(solid.vertices)
    views, normals = depth_views(vertices, solid.faces, rng)
    uniform, near = signed_distances(vertices, solid.faces, rng, queries)
    meta = {
        "name": mesh.name,
        "category": mesh.category,
        "source": mesh.source,
        "split": mesh.chosen_split,
        "license": mesh.license,
        "hash": mesh.content_hash,
        "units_per_canonical": scale,
        "method": solid.method,
        "coverage": round(coverage(vertices, solid.faces, rng), 4),
        "inside": round(float((near[:, 3] < 0).mean()), 4),
    }
    return Shape(
        vertices=vertices,
        faces=solid.faces,
        views=views.astype(np.float16),
        normals=np.rint(NORMAL_STEPS * normals).astype(np.int8),
        sdf_uniform=uniform,
        sdf_near=near,
        fingerprint=fingerprint(vertices, solid.faces),
        meta=meta,
    )


def fingerprint(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "8 8 8"]:
    """Signed distances on a grid of the canonical box, float16: alike for shapes that are alike."""
    axis = (np.arange(FINGERPRINT_SIDE) + 0.5) / FINGERPRINT_SIDE * 2 * BOX - BOX
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    distance, _, _ = pcu.closest_points_on_mesh(grid, vertices, np.ascontiguousarray(faces, np.int32))
    signed = np.where(is_inside(vertices, faces, grid), -distance, distance)
    return signed.reshape((FINGERPRINT_SIDE,) * 3).astype(np.float16)
