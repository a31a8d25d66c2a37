"""Point clouds subsampled and meshes simplified by vertex clustering, small enough for a page."""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Float, Int

from more2_jax.types import Mesh

MAX_POINTS = 500_000  # of a page
MAX_FACES = 150_000  # of a page
MAX_COARSE_FACES = 10_000  # of a page, while things move
MAX_POINTS_WITH_DETAILS = 200_000  # of a page that reads finer ones
MAX_DETAIL_POINTS = 30_000  # of one object beside the page
MAX_DETAIL_FACES = 30_000  # of one object beside the page


def kept_share(total: int, most: int) -> float:
    """The share to keep of each part so that all parts together keep to `most`."""
    return min(1.0, most / max(total, 1))


def random_subsample(
    points: Float[np.ndarray, "n 3"], share: float, seed: int = 0
) -> Float[np.ndarray, "m 3"]:
    """A share of the points in random order, at least one: any first part of it is an even sample too."""
    keep = min(len(points), max(1, round(share * len(points))))
    return points[np.random.default_rng(seed).permutation(len(points))[:keep]]


def cluster_vertices(mesh: Mesh, share: float) -> Mesh:
    """The mesh with about a `share` of its faces: vertices in one cell of a grid become one, at their mean."""
    if share >= 1:
        return mesh
    owner, faces = _clustered(mesh, share * len(mesh.faces))
    counts = np.bincount(owner)
    vertices = np.stack([np.bincount(owner, mesh.vertices[:, k]) / counts for k in range(3)], axis=1)
    result = trimesh.Trimesh(vertices, faces, process=False)
    result.remove_unreferenced_vertices()
    return Mesh(vertices=np.asarray(result.vertices), faces=np.asarray(result.faces, np.int32))


def coarse_faces(mesh: Mesh, most: int) -> Int[np.ndarray, "f 3"]:
    """About `most` faces between vertices the mesh has: of those in one cell of a grid, the one nearest their mean."""
    if len(mesh.faces) <= most:
        return mesh.faces
    owner, faces = _clustered(mesh, float(most))
    counts = np.bincount(owner)
    middle = np.stack([np.bincount(owner, mesh.vertices[:, k]) / counts for k in range(3)], axis=1)
    far = np.linalg.norm(mesh.vertices - middle[owner], axis=1)
    order = np.lexsort((far, owner))
    nearest = order[np.searchsorted(owner[order], np.arange(len(counts)))]
    return nearest[faces]


def _clustered(mesh: Mesh, most: float) -> tuple[Int[np.ndarray, " v"], Int[np.ndarray, "f 3"]]:
    """The cell of every vertex in a grid so coarse that at most `most` faces span three cells, and these faces.

    The grid stops at a quarter of the mesh's size, where more faces may remain.
    """
    size = float(np.ptp(mesh.vertices, axis=0).max())
    edge = float(np.median(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).edges_unique_length))
    cell = max(edge, size / 500, 1e-9)
    while True:
        _, owner = np.unique(np.floor(mesh.vertices / cell).astype(np.int64), axis=0, return_inverse=True)
        owner = owner.reshape(-1)
        faces = _distinct(owner[mesh.faces])
        cell *= 1.2
        if len(faces) <= most or cell >= size / 4:
            return owner, faces


def _distinct(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "g 3"]:
    """Faces with three corners, each once. One seen from its other side is another: thin plates keep both."""
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    turned = (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3
    return np.unique(np.take_along_axis(faces, turned, axis=1), axis=0)
