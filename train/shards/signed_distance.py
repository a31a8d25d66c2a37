"""Signed distances of closed solids: the queries that training asks for (paper §3.1)."""

from __future__ import annotations

import numpy as np
import point_cloud_utils as pcu
import trimesh
from jaxtyping import Bool, Float, Int
from trimesh.ray.ray_pyembree import RayMeshIntersector

QUERIES = 50_000  # of each kind, a shape
BOX = 0.55  # half the edge of the box of uniform queries, canonical units
NEAR_STD = (0.01, 0.05)  # of near-surface queries: half tell the sign, half the slope
CHECKED = 4000  # queries whose sign is also asked of the winding number
AGREEMENT = 0.995


def signed_distances(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    rng: np.random.Generator,
    count: int = QUERIES,
) -> tuple[Float[np.ndarray, "q 4"], Float[np.ndarray, "q 4"]]:
    """`count` uniform and `count` near-surface queries with their distances, negative inside; float16.

    `vertices` and `faces` are a closed solid in canonical units. Distances belong to the rounded positions.
    Raises ValueError where two ways to tell inside from outside disagree: then the solid is not one.
    """
    vertices, faces = np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int32)
    seed = int(rng.integers(1, 2**31))  # 0 would mean the clock
    index, weights = pcu.sample_mesh_random(vertices, faces, count, random_seed=seed)
    on_solid = pcu.interpolate_barycentric_coords(faces, index, weights, vertices)
    std = np.where(np.arange(count) % 2, *NEAR_STD)[:, None]
    near = on_solid + std * rng.normal(size=(count, 3))
    uniform = rng.uniform(-BOX, BOX, (count, 3))
    query = np.concatenate([uniform, near]).astype(np.float16).astype(np.float64)
    distance, _, _ = pcu.closest_points_on_mesh(query, vertices, faces)
    inside = is_inside(vertices, faces, query)
    check_signs(
        vertices, faces, query[:: max(1, 2 * count // CHECKED)], inside[:: max(1, 2 * count // CHECKED)]
    )
    labeled = np.column_stack([query, np.where(inside, -distance, distance)]).astype(np.float16)
    return labeled[:count], labeled[count:]


def is_inside(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], query: Float[np.ndarray, "q 3"]
) -> Bool[np.ndarray, " q"]:
    """Whether points lie inside a closed solid, by counting crossings of rays."""
    return RayMeshIntersector(trimesh.Trimesh(vertices, faces, process=False)).contains_points(query)


def check_signs(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    query: Float[np.ndarray, "q 3"],
    inside: Bool[np.ndarray, " q"],
) -> None:
    """Raises ValueError if winding numbers agree with `inside` on less than 99.5 % of the points."""
    winding = pcu.triangle_soup_fast_winding_number(vertices, faces, np.ascontiguousarray(query))
    if (agreement := float(np.mean((winding > 0.5) == inside))) < AGREEMENT:
        raise ValueError(f"rays and winding numbers agree on {agreement:.4f} of signs; needed {AGREEMENT}")
