"""Clouds at even spacing, on the host: one mean point an occupied voxel, and its normal."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Integer
from scipy.spatial import KDTree

LARGEST_GRID = 2**20  # voxels along an axis


def voxel_means(
    points: Float[np.ndarray, "n 3"], size_m: float
) -> tuple[Float[np.ndarray, "v 3"], Integer[np.ndarray, "n"]]:
    """Centroids of the occupied voxels, in an order that does not depend on the points', and whose is whose.

    Raises ValueError for a cloud too wide for the grid.
    """
    low = points.min(axis=0)
    extent = float((points.max(axis=0) - low).max())
    if extent > size_m * LARGEST_GRID:
        raise ValueError(f"the cloud measures {extent:.4g} m; needed at most {size_m * LARGEST_GRID:.4g} m")
    cell = np.floor((points - low) / size_m).astype(np.int64)
    key = (cell[:, 0] << 42) + (cell[:, 1] << 21) + cell[:, 2]
    _, voxel_of, count = np.unique(key, return_inverse=True, return_counts=True)
    sums = [np.bincount(voxel_of, points[:, axis]) for axis in range(3)]
    return np.stack(sums, axis=-1) / count[:, None], voxel_of


def voxel_normals(voxels: Float[np.ndarray, "v 3"], neighbors: int) -> Float[np.ndarray, "v 3"]:
    """Direction of least spread among the nearest voxels; its sign means nothing."""
    k = min(neighbors, len(voxels))
    near = KDTree(voxels).query(voxels, k=k)[1].reshape(len(voxels), k)
    centered = voxels[near] - voxels[near].mean(axis=1, keepdims=True)
    return np.linalg.eigh(np.einsum("vki,vkj->vij", centered, centered))[1][:, :, 0]
