"""Signed distances of polygon soups: made watertight first, then queried (METHOD 2)."""

from __future__ import annotations

import numpy as np
import point_cloud_utils as pcu
from jaxtyping import Float, Int

QUERIES = 8000  # of each kind, a shape
BOX = 0.55  # half the edge of the box of uniform queries, canonical units
NEAR_STD = (0.01, 0.05)  # of near-surface queries: half tell the sign, half the slope
RESOLUTION = 20_000  # octree cells: about 0.5 s a shape, surface 0.01 outside the soup's
SHELL = 0.003  # how much thicker than the soup the solid is: a board without thickness keeps an inside


def canonical(vertices: Float[np.ndarray, "v 3"]) -> tuple[Float[np.ndarray, "v 3"], float]:
    """Bounding box centred at the origin, longest edge 0.9; and source units per canonical unit.

    Raises ValueError if there are no vertices, or their extent is zero or not finite.
    """
    if not len(vertices):
        raise ValueError("no vertices; needed a shape with some")
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    scale = float((high - low).max()) / 0.9
    if not np.isfinite(scale) or scale <= 0:
        raise ValueError(f"extent {high - low}; needed a shape with some")
    return (vertices - (low + high) / 2) / scale, scale


def signed_distances(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    surface: Float[np.ndarray, "s 3"],
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "q 4"], Float[np.ndarray, "q 4"]]:
    """Uniform and near-surface queries with their distances, negative inside; canonical units.

    The watertight mesh lies a constant distance outside the soup; that offset is measured at `surface`,
    points known to lie on it, and taken off. Raises ValueError when it is not constant: then the solid is not
    the shape.
    """
    solid, solid_faces = pcu.make_mesh_watertight(
        vertices.astype(np.float64), faces.astype(np.int32), resolution=RESOLUTION
    )
    # Seed 0 would mean the clock.
    seed = int(rng.integers(1, 2**31))
    index, weights = pcu.sample_mesh_random(solid, solid_faces, QUERIES, random_seed=seed)
    on_solid = pcu.interpolate_barycentric_coords(solid_faces, index, weights, solid)
    uniform = rng.uniform(-BOX, BOX, (QUERIES, 3))
    std = np.where(np.arange(QUERIES) % 2, *NEAR_STD)[:, None]
    near = on_solid + std * rng.normal(size=(QUERIES, 3))
    distance = pcu.signed_distance_to_mesh(np.concatenate([uniform, near, surface]), solid, solid_faces)[0]
    distance = distance + measured_offset(distance[2 * QUERIES :]) - SHELL
    return (
        np.column_stack([uniform, distance[:QUERIES]]),
        np.column_stack([near, distance[QUERIES : 2 * QUERIES]]),
    )


def measured_offset(at_surface: Float[np.ndarray, " s"]) -> float:
    """How far outside the soup the solid's surface lies; ValueError if it is out of range or uneven."""
    offset = -float(np.median(at_surface))
    if not 0.002 < offset < 0.013:
        raise ValueError(f"watertight surface lies {offset:.4f} outside; needed 0.002 to 0.013")
    if (spread := float(np.quantile(np.abs(at_surface + offset - SHELL), 0.9))) > 0.012:
        raise ValueError(f"a tenth of the seen points lie {spread:.4f} or more off the solid; needed 0.012")
    return offset
