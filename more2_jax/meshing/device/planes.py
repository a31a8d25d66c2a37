"""Planes through the neighbors of every point, and the area it stands for; as `meshing.planes` on the host."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from more2_jax.geometry.points import dominant_eigenvector
from more2_jax.meshing.device.rows import at_rows, masked_median
from more2_jax.meshing.observed_surface import NOISELESS
from more2_jax.meshing.planes import FACE_NEIGHBORS, LEAST_ASPECT
from more2_jax.meshing.screened_poisson import SAME_FACE_COSINE, SAME_FACE_FLATNESS
from more2_jax.types import pytree, quantity

TINY = 1e-30
ONE_PLACE = 4 * float(
    jnp.finfo(jnp.float32).eps
)  # closer points of an object of about unit size are at one place

Points = Float[Array, "n 3"]
Neighbors = Int[Array, "n k"]


@pytree
class Planes:
    """Of every point the plane through its neighbors; canonical units, normals of either sign."""

    center: Points = quantity("position")
    normal: Points = quantity("direction")
    residual: Float[Array, ""] = quantity("length")  # how far off the planes their points lie, typically
    noiseless: Bool[Array, ""] = quantity("invariant")


def fit_planes(points: Points, mask: Bool[Array, " n"], neighbors: Neighbors) -> Planes:
    """Planes of least squares; of points without noise, those that lie within one face beside an edge."""
    center, covariance = moments(points, neighbors)
    normal = least_axes(covariance)
    residual_variance = jax.lax.stop_gradient(masked_median(variance_along(covariance, normal), mask))
    spread = masked_median(jax.lax.stop_gradient(jnp.trace(covariance, axis1=1, axis2=2)), mask)
    residual = jnp.sqrt(jnp.maximum(residual_variance, 0.0))
    noiseless = residual < NOISELESS * jnp.sqrt(spread)
    return Planes(
        center=jnp.where(noiseless, points, center),
        normal=jnp.where(noiseless, face_normals(points, neighbors, normal), normal),
        residual=residual,
        noiseless=noiseless,
    )


def face_normals(points: Points, neighbors: Neighbors, otherwise: Points) -> Points:
    """Normals of the plane nearby that fits its own points and this one best; `meshing.planes.face_normals`."""
    center, covariance = moments(points, neighbors[:, :FACE_NEIGHBORS])
    normal = least_axes(covariance)
    residual = variance_along(covariance, normal)
    is_plane = jax.lax.stop_gradient(aspect(covariance, residual) > LEAST_ASPECT)
    offset = ((points[:, None] - at_rows(center, neighbors)) * at_rows(normal, neighbors)).sum(axis=-1)
    known = at_rows(is_plane, neighbors)
    misfit = jnp.where(known, at_rows(residual, neighbors) + offset**2, jnp.inf)
    best = jnp.take_along_axis(neighbors, misfit.argmin(axis=1)[:, None], axis=1)[:, 0]
    return jnp.where(known.any(axis=1)[:, None], at_rows(normal, best), otherwise)


def moments(points: Points, neighbors: Neighbors) -> tuple[Points, Float[Array, "n 3 3"]]:
    """Mean and covariance of each point's neighbors; of neighbors at one place it is zero.

    What rounding leaves of it there would be divided by itself, and gradients would overflow.
    """
    around = at_rows(points, neighbors)
    center = around.mean(axis=1)
    around = around - center[:, None]
    around = jnp.where(jnp.abs(around).max(axis=(1, 2), keepdims=True) > ONE_PLACE, around, 0.0)
    return center, jnp.einsum("nki,nkj->nij", around, around) / neighbors.shape[1]


def least_axes(covariance: Float[Array, "n 3 3"]) -> Points:
    """Unit eigenvectors of the smallest eigenvalues; by repeated squaring, so that gradients are finite."""
    size = jnp.trace(covariance, axis1=1, axis2=2)[:, None, None]
    flipped = jnp.eye(3) - covariance / jnp.maximum(size, TINY)
    return jax.vmap(dominant_eigenvector)(flipped)


def variance_along(covariance: Float[Array, "n 3 3"], axis: Points) -> Float[Array, " n"]:
    """Variance along unit axes."""
    return jnp.einsum("ni,nij,nj->n", axis, covariance, axis)


def aspect(covariance: Float[Array, "n 3 3"], least: Float[Array, " n"]) -> Float[Array, " n"]:
    """The middle eigenvalue as a share of the largest, given the least: 0 of points of a line."""
    both = jnp.trace(covariance, axis1=1, axis2=2) - least
    squares = (covariance**2).sum(axis=(1, 2)) - least**2
    apart = jnp.sqrt(jnp.maximum(2 * squares - both**2, 0.0))
    return (both - apart) / jnp.maximum(both + apart, TINY)


def surface_areas(
    points: Points, normal: Points, distance: Float[Array, "n k"], neighbors: Neighbors
) -> Float[Array, " n"]:
    """The share of the surface each point stands for: of the disc that holds its neighbors on the same face."""
    offset = at_rows(points, neighbors) - points[:, None]
    along = (offset * normal[:, None]).sum(axis=-1) ** 2
    facing = (at_rows(normal, neighbors) * normal[:, None]).sum(axis=-1)
    same = (facing > SAME_FACE_COSINE) & (along <= SAME_FACE_FLATNESS * distance**2)
    return jnp.pi * distance[:, -1] ** 2 / jnp.maximum(same.sum(axis=1), 2)
