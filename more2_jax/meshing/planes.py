"""Planes through neighboring points of one cloud, their normals, and how rough the points are."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from more2_jax.geometry.padding import MIN_POINTS, bucket
from more2_jax.geometry.point_to_plane import least_axis
from more2_jax.types import pytree

OF_FACE = 6  # points of a plane, where they are exact,
WIDE = 0.05  # unless their second variance is a smaller share of the first: points of a line lie in any plane


@pytree
class Planes:
    """Of every point; normals have unit length and either sign."""

    center: Float[Array | np.ndarray, "n 3"]  # the mean of its neighbors
    normal: Float[Array | np.ndarray, "n 3"]  # of their plane of least squares
    off: Float[Array | np.ndarray, " n"]  # their variance off that plane
    spread: Float[Array | np.ndarray, " n"]  # and in all
    face: Float[Array | np.ndarray, "n 3"]  # the normal of the face it lies on, if points are exact


def planes_of(points: Float[np.ndarray, "n 3"], near: Int[np.ndarray, "n k"]) -> Planes:
    """`planes` on the host, of a cloud of any size: padded by points that no neighbor of its own names."""
    size = bucket(len(points), MIN_POINTS)
    cloud, rows = np.zeros((size, 3), np.float32), np.zeros((size, near.shape[1]), np.int32)
    cloud[: len(points)], rows[: len(points)] = points, near
    found = jax.device_get(planes(cloud, rows))
    return jax.tree.map(lambda x: np.asarray(x, np.float64)[: len(points)], found)


@jax.jit
def planes(points: Float[Array, "n 3"], near: Int[Array, "n k"]) -> Planes:
    """The plane through each point's neighbors; `near` names them, nearest first, the point itself among them."""
    center, normal, second = fitted(points, near)
    return Planes(
        center=center,
        normal=normal,
        off=variance(second, normal),
        spread=jnp.trace(second, axis1=1, axis2=2),
        face=facing(points, near, normal),
    )


def fitted(
    points: Float[Array, "n 3"], near: Int[Array, "n k"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"], Float[Array, "n 3 3"]]:
    """The neighbors' mean, the normal (of either sign) of their plane of least squares, and their covariance."""
    around = points[near]
    center = around.mean(axis=1)
    x, y, z = jnp.moveaxis(around - center[:, None], 2, 0)
    xx, xy, xz, yy, yz, zz = (
        (a * b).mean(axis=1) for a, b in ((x, x), (x, y), (x, z), (y, y), (y, z), (z, z))
    )
    second = jnp.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
    return center, least_axis(second), second


def facing(
    points: Float[Array, "n 3"], near: Int[Array, "n k"], otherwise: Float[Array, "n 3"]
) -> Float[Array, "n 3"]:
    """Normals (of either sign) of exact points: of the plane around that its own points and this one lie best in.

    So a point beside an edge has its face's normal, not the mean of two; of a thin leg's narrow sides likewise.
    `otherwise` where all points around lie in lines, as along a scanner's.
    """
    center, normal, second = fitted(points, near[:, :OF_FACE])
    least = variance(second, normal)
    is_plane = breadth(second, least) > WIDE
    off = jnp.sum((points[:, None] - center[near]) * normal[near], axis=2)
    misfit = jnp.where(is_plane[near], least[near] + off**2, jnp.inf)
    best = jnp.take_along_axis(near, jnp.argmin(misfit, axis=1)[:, None], axis=1)[:, 0]
    return jnp.where(is_plane[near].any(axis=1)[:, None], normal[best], otherwise)


def variance(second: Float[Array, "n 3 3"], axis: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Along unit axes."""
    return jnp.sum(axis * jnp.sum(second * axis[:, None], axis=2), axis=1)


def breadth(second: Float[Array, "n 3 3"], least: Float[Array, " n"]) -> Float[Array, " n"]:
    """The middle variance as a share of the largest, given the least: 0 of points of a line."""
    both = jnp.trace(second, axis1=1, axis2=2) - least
    squares = jnp.sum(second**2, axis=(1, 2)) - least**2  # a² + b² of the other two; a + b is `both`
    apart = jnp.sqrt(jnp.maximum(2 * squares - both**2, 0.0))
    return (both - apart) / jnp.maximum(both + apart, 1e-30)
