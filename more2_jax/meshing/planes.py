"""Least-squares planes through the nearest neighbors of every point of a cloud: normals, residuals, faces at edges.

On the host, in float64: clouds differ in size, and every size would be one more compiled program.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

FACE_NEIGHBORS = (
    6  # of a plane that is to lie in one face beside an edge (docs/developing/notebook/mesh_edges.md)
)
# Where the second variance is a smaller share of the first, points lie in a line, as along a scanner's, and in any
# plane through it.
LEAST_ASPECT = 0.05
REPEATED = 1e-9  # of a matrix of trace 1: cross products shorter than this tell no axis

Points = Float[np.ndarray, "n 3"]
Neighbors = Int[np.ndarray, "n k"]
Covariance = Float[np.ndarray, "n 3 3"]


@dataclass(frozen=True, kw_only=True)
class Planes:
    """Of every point the plane through its neighbors; normals have unit length and either sign."""

    center: Points  # the neighbors' mean
    normal: Points
    residual_variance: Float[np.ndarray, " n"]  # of the neighbors, off the plane
    total_variance: Float[np.ndarray, " n"]


def fit_planes(points: Points, neighbors: Neighbors) -> Planes:
    """The plane of least squares through each point's neighbors; those name rows, the point's own among them."""
    center, covariance = neighborhood_moments(points, neighbors)
    normal = least_axes(covariance)
    return Planes(
        center=center,
        normal=normal,
        residual_variance=variance_along(covariance, normal),
        total_variance=np.trace(covariance, axis1=1, axis2=2),
    )


def face_normals(points: Points, neighbors: Neighbors, otherwise: Points) -> Points:
    """Normals (of either sign) of points without noise: of the plane nearby that fits its own points and this one best.

    Of the candidates, planes through six neighbors each, one lies within the point's own face, where the plane of
    twelve neighbors beside an edge is the mean of two faces. `otherwise` where all points around lie in lines.
    `neighbors`: nearest first, the point itself among them.
    """
    center, covariance = neighborhood_moments(points, neighbors[:, :FACE_NEIGHBORS])
    normal = least_axes(covariance)
    residual = variance_along(covariance, normal)
    is_plane = np.asarray(aspect(covariance, residual) > LEAST_ASPECT)
    # n · (p − c), with n · c made once for every plane and not for every pair
    offset = np.einsum("ni,nki->nk", points, normal[neighbors])
    offset -= np.einsum("ni,ni->n", normal, center)[neighbors]
    misfit = np.where(is_plane[neighbors], residual[neighbors] + offset**2, np.inf)
    best = np.take_along_axis(neighbors, misfit.argmin(axis=1)[:, None], axis=1)[:, 0]
    return np.where(np.any(is_plane[neighbors], axis=1)[:, None], normal[best], otherwise)


def neighborhood_moments(points: Points, neighbors: Neighbors) -> tuple[Points, Covariance]:
    """Mean and covariance of each point's neighbors."""
    around = np.moveaxis(points[neighbors], 2, 0)
    center = around.mean(axis=2)
    around = around - center[:, :, None]
    covariance = np.empty((len(points), 3, 3))
    for i in range(3):
        for j in range(i + 1):
            covariance[:, i, j] = covariance[:, j, i] = np.einsum("nk,nk->n", around[i], around[j])
    return center.T, covariance / neighbors.shape[1]


def least_axes(covariance: Covariance) -> Points:
    """Unit eigenvectors of the smallest eigenvalues of symmetric matrices.

    In closed form, a third of the time of `numpy.linalg.eigh`: the rows of A − λ span the plane across the axis, so the
    cross product of two is along it. Where the smallest eigenvalue is (nearly) repeated, `eigh` gives one of its axes.
    """
    size = np.trace(covariance, axis1=1, axis2=2)
    a = covariance / np.maximum(size, np.finfo(float).tiny)[:, None, None]
    b = a - np.eye(3) * (np.trace(a, axis1=1, axis2=2) / 3)[:, None, None]
    p = np.sqrt(np.einsum("nij,nij->n", b, b) / 6)
    det = np.einsum("ni,ni->n", b[:, 0], np.cross(b[:, 1], b[:, 2]))
    angle = np.arccos(np.clip(det / np.maximum(2 * p**3, np.finfo(float).tiny), -1.0, 1.0)) / 3
    m = b - np.eye(3) * (2 * p * np.cos(angle + 2 * np.pi / 3))[:, None, None]
    crossed = np.stack([np.cross(m[:, i], m[:, (i + 1) % 3]) for i in range(3)], axis=1)
    squared = np.einsum("nij,nij->ni", crossed, crossed)
    row = np.arange(len(m)), squared.argmax(axis=1)
    axis, length = crossed[row], np.sqrt(squared[row])
    repeated = ~(length > REPEATED)
    axis[repeated], length[repeated] = np.linalg.eigh(covariance[repeated])[1][:, :, 0], 1.0
    return axis / length[:, None]


def variance_along(covariance: Covariance, axis: Points) -> Float[np.ndarray, " n"]:
    """Variance along unit axes."""
    return np.einsum("ni,nij,nj->n", axis, covariance, axis)


def aspect(covariance: Covariance, least: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """The middle eigenvalue as a share of the largest, given the least: 0 of points of a line."""
    both = np.trace(covariance, axis1=1, axis2=2) - least
    squares = (
        np.einsum("nij,nij->n", covariance, covariance) - least**2
    )  # a² + b² of the other two; a + b is `both`
    apart = np.sqrt(np.maximum(2 * squares - both**2, 0.0))
    return (both - apart) / np.maximum(both + apart, np.finfo(float).tiny)
