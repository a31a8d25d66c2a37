"""Clouds and meshes made small enough for a page."""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Float

from more2_jax.types import Mesh

MOST_POINTS = 500_000  # of a page
MOST_FACES = 240_000  # of a page


def share_of(total: int, most: int) -> float:
    """The share to keep of each part so that all parts together keep to `most`."""
    return min(1.0, most / max(total, 1))


def thinned(points: Float[np.ndarray, "n 3"], share: float, seed: int = 0) -> Float[np.ndarray, "m 3"]:
    """A share of the points in random order, at least one: any first part of it is an even sample too."""
    keep = min(len(points), max(1, round(share * len(points))))
    return points[np.random.default_rng(seed).permutation(len(points))[:keep]]


def simplified(mesh: Mesh, share: float) -> Mesh:
    """The mesh with about a `share` of its faces: vertices in one cell of a grid become one, cells grow as needed."""
    if share >= 1:
        return mesh
    size = float(np.ptp(mesh.vertices, axis=0).max())
    edge = float(np.median(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).edges_unique_length))
    cell, small = max(edge, size / 500, 1e-9), mesh
    while cell < size / 8:
        small = _clustered(mesh, cell)
        if len(small.faces) <= share * len(mesh.faces):
            break
        cell *= 1.2
    return small


def _clustered(mesh: Mesh, cell: float) -> Mesh:
    """Every vertex to the mean of its grid cell's; faces that collapse, or come twice, are dropped."""
    _, owner = np.unique(np.floor(mesh.vertices / cell).astype(np.int64), axis=0, return_inverse=True)
    owner = owner.reshape(-1)
    counts = np.bincount(owner)
    vertices = np.stack([np.bincount(owner, mesh.vertices[:, k]) / counts for k in range(3)], axis=1)
    faces = owner[mesh.faces]
    result = trimesh.Trimesh(vertices, faces, process=False)
    result.update_faces(result.nondegenerate_faces() & result.unique_faces())
    result.remove_unreferenced_vertices()
    return Mesh(vertices=np.asarray(result.vertices), faces=np.asarray(result.faces, np.int32))
