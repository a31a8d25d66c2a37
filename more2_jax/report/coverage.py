"""How much of an object's surface the scans have seen."""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import KDTree

from more2_jax.types import Mesh

SAMPLES = 2000  # of the surface
POINTS = 20_000  # of the cloud, at most
TOLERANCE = 0.03  # of the mesh's diagonal: nearer counts as seen


def coverage(mesh: Mesh, points: Float[np.ndarray, "n 3"]) -> float:
    """Share of the mesh's surface, 0 to 1, that has a scanned point within 3 % of the object's diagonal.

    Both in the same frame, meters. Where a cloud is so thin that its points lie further apart, twice their
    median spacing counts instead: a sparse scan is not a partial one. 0 without points or surface.
    """
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    if len(points) == 0 or not surface.area > 0:
        return 0.0
    thin = points[:: max(1, -(-len(points) // POINTS))]
    samples = np.asarray(trimesh.sample.sample_surface(surface, SAMPLES, seed=0)[0])
    tree = KDTree(thin)
    spacing = float(np.median(tree.query(thin, k=2)[0][:, 1])) if len(thin) > 1 else 0.0
    near = max(TOLERANCE * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))), 2 * spacing)
    return float((tree.query(samples)[0] <= near).mean())
