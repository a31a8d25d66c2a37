"""A field on a lattice drawn toward the planes of the points nearby; as `meshing.observed_surface` on the host."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from more2_jax.meshing.device.lattice import axis_places, nearest_on_lattice
from more2_jax.meshing.device.planes import surface_areas
from more2_jax.meshing.device.rows import at_rows
from more2_jax.meshing.observed_surface import (
    CUTOFF,
    FACING_POWER,
    NOT_FACING,
    QUERY_PLANES,
    QUERY_PLANES_NOISELESS,
)
from more2_jax.types import pytree, quantity

Grid = Float[Array, "i j k"]
LIGHTEST = -1e4  # the logarithm of no weight


@pytree
class OrientedPlanes:
    """Real points first, each with its plane; canonical units."""

    points: Float[Array, "n 3"] = quantity("position")
    mask: Bool[Array, " n"] = quantity("invariant")
    center: Float[Array, "n 3"] = quantity("position")
    normal: Float[Array, "n 3"] = quantity("direction")  # outward
    distance: Float[Array, "n k"] = quantity("length")
    neighbors: Int[Array, "n k"] = quantity("invariant")
    gap: Float[Array, ""] = quantity("length")
    residual: Float[Array, ""] = quantity("length")
    noiseless: Bool[Array, ""] = quantity("invariant")


def areas(planes: OrientedPlanes) -> Float[Array, " n"]:
    """The share of the surface each point stands for."""
    return surface_areas(planes.points, planes.normal, planes.distance, planes.neighbors)


def query_planes(planes: OrientedPlanes) -> Float[Array, "k n 8"]:
    """Of every point, the planes that a corner nearest to it is measured to: its own, and those of its neighbors.

    Two linear functions of a corner's offset from the point, each as x, y, z and constant: the height over the plane,
    and the logarithm of its weight.
    """
    own = jnp.arange(len(planes.points), dtype=planes.neighbors.dtype)
    near = planes.neighbors[:, :QUERY_PLANES].T.at[0].set(own)
    normal, toward = at_rows(planes.normal, near), at_rows(planes.points, near) - planes.points
    height = (normal * (planes.points - at_rows(planes.center, near))).sum(axis=-1)
    facing = FACING_POWER * jnp.log(jnp.maximum((normal * planes.normal).sum(axis=-1), NOT_FACING))
    closeness = facing - 0.5 * (toward**2).sum(axis=-1) / planes.gap**2
    heard = jnp.arange(QUERY_PLANES) < jnp.where(planes.noiseless, QUERY_PLANES_NOISELESS, QUERY_PLANES)
    closeness = jnp.where(heard[:, None], closeness, LIGHTEST)
    parts = [normal, height[..., None], toward / planes.gap**2, closeness[..., None]]
    return jnp.concatenate(parts, axis=-1)


def corrected(
    field: Grid, planes: OrientedPlanes, cells: int, half_width: Float[Array, ""], bandwidth: float
) -> Grid:
    """The field drawn toward the signed distance from the planes, near points; elsewhere as it is."""
    nearest = nearest_on_lattice(planes.points, planes.mask, cells, half_width)
    axis, point = axis_places(cells, half_width), at_rows(planes.points, nearest)
    x, y, z = (a - point[..., i] for i, a in enumerate((axis[:, None, None], axis[:, None], axis)))

    def heard(total: tuple[Grid, Grid], of_plane: Float[Array, "n 8"]) -> tuple[tuple[Grid, Grid], None]:
        p = jnp.moveaxis(at_rows(of_plane, nearest), -1, 0)
        weight = jnp.exp(p[4] * x + p[5] * y + p[6] * z + p[7])
        signed = p[0] * x + p[1] * y + p[2] * z + p[3]
        return (total[0] + weight, total[1] + weight * signed), None

    none = jnp.zeros_like(field)
    (weight, weighted), _ = jax.lax.scan(jax.checkpoint(heard), (none, none), query_planes(planes))
    cutoff = CUTOFF * jnp.hypot(bandwidth, planes.gap)
    squared = x**2 + y**2 + z**2
    near = squared < cutoff**2
    plane = jnp.where(near, weighted, 0.0) / jnp.where(near, weight, 1.0)
    along = jnp.maximum(squared - plane**2, 0.0)
    share = jnp.exp(-((plane / bandwidth) ** 4) - (jnp.where(near, along, 0.0) / planes.gap**2) ** 2)
    return jnp.where(near, field + share * (plane - field), field)
