"""Where nobody looked, a field on a lattice must be sure to be inside; as `meshing.unseen` on the host."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from more2_jax.meshing.device.correction import OrientedPlanes, areas
from more2_jax.meshing.device.lattice import corners, nearest_on_lattice
from more2_jax.meshing.device.rows import at_rows, evenly, masked_median
from more2_jax.meshing.unseen import BETWEEN, FULL_RISE, RISE_REACH, WINDING_POINTS

CORNERS_AT_ONCE = 1024  # their distances from all points are held at once
TOUCHING = 1e-6  # canonical units: no distance is smaller, as the root's slope at 0 is infinite

Grid = Float[Array, "c c c"]


def raised(planes: OrientedPlanes, field: Grid, half_width: Float[Array, ""], rise: Float[Array, ""]) -> Grid:
    """The field at the corners of a cube, risen with the distance from what was observed."""
    cells = len(field) - 1
    place = corners(cells, half_width)
    nearest = nearest_on_lattice(planes.points, planes.mask, cells, half_width).ravel()
    squared = ((place - at_rows(planes.points, nearest)) ** 2).sum(axis=1)
    between = BETWEEN * jnp.sqrt(masked_median(areas(planes), planes.mask))
    distance = jnp.clip(jnp.sqrt(jnp.maximum(squared, TOUCHING**2)) - between, 0.0, RISE_REACH)
    share = jnp.clip((1.0 - winding_number(place, planes)) / (1.0 - FULL_RISE), 0.0, 1.0)
    share = jnp.where(field.ravel() < 0, share, 1.0)
    return field + (rise * distance * share).reshape(field.shape)


def winding_number(queries: Float[Array, "q 3"], planes: OrientedPlanes) -> Float[Array, " q"]:
    """How often the observed faces surround each query, by at most `WINDING_POINTS` of the points."""
    count, most = planes.mask.sum(), min(WINDING_POINTS, len(planes.points))
    row, real = evenly(count, most)
    points, normals, area = (at_rows(x, row) for x in (planes.points, planes.normal, areas(planes)))
    area = jnp.where(real, area * count / jnp.minimum(count, most), 0.0)
    own, squared = (points * normals).sum(axis=1), (points**2).sum(axis=1)
    rim = jnp.maximum(area / jnp.pi, TOUCHING**2)

    def surrounded(q: Float[Array, "m 3"]) -> Float[Array, " m"]:
        apart = jnp.maximum(squared + (q**2).sum(axis=1)[:, None] - 2 * q @ points.T, rim)
        return ((own - q @ normals.T) / (apart * jnp.sqrt(apart))) @ (area / (4 * jnp.pi))

    rows = jnp.pad(queries, ((0, -len(queries) % CORNERS_AT_ONCE), (0, 0))).reshape(-1, CORNERS_AT_ONCE, 3)
    return jax.lax.map(jax.checkpoint(surrounded), rows).ravel()[: len(queries)]
