"""From one padded cloud and its code to values on a grid: every step of `meshing.extract`, as one pure function."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from more2_jax.config import MeshingConfig
from more2_jax.geometry.free_space import VIEWS
from more2_jax.geometry.full_precision import full_precision
from more2_jax.geometry.points import cleared, nearest_index
from more2_jax.meshing.device.box import in_box
from more2_jax.meshing.device.correction import OrientedPlanes, areas, corrected
from more2_jax.meshing.device.lattice import axis_places, corners, upsampled
from more2_jax.meshing.device.neighbors import inliers, nearest_neighbors, with_slopes
from more2_jax.meshing.device.planes import fit_planes
from more2_jax.meshing.device.rows import at_rows, evenly, masked_median, real_first
from more2_jax.meshing.device.screened import screened_poisson
from more2_jax.meshing.device.sides import Cloud, Views, outward_signs
from more2_jax.meshing.device.unseen import raised
from more2_jax.meshing.extract import ACCELERATOR_CHUNK, CHUNK, HALF_WIDTH, MAX_LEVEL, SAMPLES
from more2_jax.meshing.observed_surface import (
    GAP_SPACINGS,
    MIN_GAP,
    MIN_POINTS,
    PLANE_NEIGHBORS,
    RESOLVED_RESIDUAL,
)
from more2_jax.meshing.screened_poisson import empty_space
from more2_jax.network.decoder import ObjectField
from more2_jax.network.prior import Prior, field_sdf, object_field
from more2_jax.types import AnyArray, Embedding, pytree, quantity

Grid = Float[Array, "i j k"]
Points = Float[Array, "n 3"]
Ask = Callable[[Float[Array, "q 3"]], Float[Array, " q"]]  # the field at canonical offsets


@pytree
class PaddedObject:
    """One object as the device takes it; canonical units, relative to the center of its code."""

    embedding: Embedding = quantity("record")  # without its origin
    points: Float[AnyArray, "*b n 3"] = quantity("position")
    mask: Bool[AnyArray, "*b n"] = quantity("invariant")
    views: Views = quantity("record")
    half_width: Float[AnyArray, "*b"] = quantity("length")  # of the query box
    lowest: Float[AnyArray, "*b"] = quantity("length")  # nothing lies below; −∞ where there is no floor
    several: Bool[AnyArray, "*b"] = quantity("invariant")  # whether several scans saw it
    rise: Float[AnyArray, "*b"] = quantity("invariant")  # of the field where nobody looked


def observed_object(
    embedding: Embedding,
    points: Float[Array, "n 3"],
    mask: Bool[AnyArray, " n"],
    half_width: float = HALF_WIDTH,
) -> PaddedObject:
    """One padded cloud (meters, the embedding's local frame) as `surface_values` takes it; all may be traced.

    As one scan saw it, without floor, sensors or normals. `half_width`: of the query box, canonical units.
    """
    known = jnp.asarray(mask)
    placed = (cleared(points, known) - embedding.center) / embedding.scale
    sensors = jnp.full((len(placed), VIEWS, 3), jnp.nan, placed.dtype)
    views = Views(sensors=sensors, normals=jnp.zeros_like(placed), known=jnp.array(False))
    return PaddedObject(
        embedding=dataclasses.replace(embedding, origin=None),
        points=placed,
        mask=known,
        views=views,
        half_width=jnp.asarray(half_width, placed.dtype),
        lowest=jnp.asarray(-jnp.inf, placed.dtype),
        several=jnp.array(False),
        rise=jnp.zeros((), placed.dtype),
    )


@full_precision
def surface_values(prior: Prior, o: PaddedObject, config: MeshingConfig) -> Float[Array, "r r r"]:
    """Values at the corners of a cube of `config.resolution` cells, negative inside; as the host's, to their sign.

    Differentiable with respect to the points, the code and the weights, but for which points are neighbors, inliers,
    and on which side matter lies.
    """
    cells = config.resolution
    o = without_outliers(o, config)
    field = object_field(prior, o.embedding)
    ask = partial(canonical_field, prior, o.embedding, field)
    asked = asked_cells(config)
    level = observed_level(ask, o) if config.level == "observed" else 0.0
    coarse = ask(corners(asked, o.half_width)).reshape((asked + 1,) * 3) - level
    below = o.lowest - axis_places(cells, o.half_width)
    values = at_resolution(coarse, cells)
    if config.mls_bandwidth:
        drawn = drawn_to_points(ask, o, coarse, below, config)
        values = jnp.where(o.mask.sum() >= MIN_POINTS, drawn, values)
    return jnp.maximum(values, below)


def at_resolution(coarse: Float[Array, "c c c"], cells: int) -> Float[Array, "r r r"]:
    """A field interpolated to so many cells a side."""
    while len(coarse) - 1 < cells:
        coarse = upsampled(coarse)
    return coarse


def drawn_to_points(
    ask: Ask,
    o: PaddedObject,
    coarse: Float[Array, "c c c"],
    below: Float[Array, " r"],
    config: MeshingConfig,
) -> Grid:
    """The field where there are points enough: inside and outside by these, near them their planes."""
    planes, cells = oriented_planes(ask, o), config.resolution
    if config.unseen_rise:
        coarse = raised(planes, coarse, o.half_width, o.rise)
    field = at_resolution(coarse, cells)
    if not (config.screening_length and len(coarse) < len(field)):
        return corrected(field, planes, cells, o.half_width, config.mls_bandwidth)
    field = screened(jnp.maximum(field, below), planes, o, config)
    drawn = corrected(field, planes, cells, o.half_width, config.mls_bandwidth)
    box = in_box(coarse, o.points, o.mask, cells, o.half_width, empty_space(config.screening_length))
    return jnp.where(box, drawn, jnp.maximum(drawn.max(), 2 * o.half_width / cells))


def asked_cells(config: MeshingConfig) -> int:
    """Cells a side of the grid on which the network is asked."""
    return max(config.coarse_resolution, min(config.field_resolution or config.resolution, config.resolution))


def without_outliers(o: PaddedObject, config: MeshingConfig) -> PaddedObject:
    """The object's inliers, first; zeros elsewhere."""
    if config.outlier_factor or config.outlier_factor_multi_scan:
        factor = jnp.where(o.several, config.outlier_factor_multi_scan, config.outlier_factor)
        mask = inliers(o.points, o.mask, factor)
    else:
        mask = o.mask
    order = real_first(mask)
    rows = jax.tree.map(lambda x: at_rows(x, order), (o.points, mask, o.views.sensors, o.views.normals))
    points = jnp.where(rows[1][:, None], rows[0], 0.0)
    views = dataclasses.replace(o.views, sensors=rows[2], normals=rows[3])
    return dataclasses.replace(o, points=points, mask=rows[1], views=views)


def canonical_field(
    prior: Prior, embedding: Embedding, field: ObjectField, queries: Float[Array, "q 3"]
) -> Float[Array, " q"]:
    """The field at canonical offsets from the center, a chunk after the other."""
    chunk = CHUNK if jax.default_backend() == "cpu" else ACCELERATOR_CHUNK
    chunk = min(chunk, len(queries))
    placed = queries * embedding.scale + embedding.center
    placed = jnp.pad(placed, ((0, -len(queries) % chunk), (0, 0))).reshape(-1, chunk, 3)
    found = jax.lax.map(jax.checkpoint(lambda some: field_sdf(prior, field, some)), placed)
    return found.reshape(-1)[: len(queries)]


def observed_level(ask: Ask, o: PaddedObject) -> Float[Array, ""]:
    """The field's median at the points, within limits."""
    row, real = evenly(o.mask.sum(), min(SAMPLES, len(o.points)))
    return jnp.clip(masked_median(ask(at_rows(o.points, row)), real), -MAX_LEVEL, MAX_LEVEL)


def oriented_planes(ask: Ask, o: PaddedObject) -> OrientedPlanes:
    """Planes through each point's neighbors, outward."""
    fixed, neighbors = nearest_neighbors(o.points, o.mask, PLANE_NEIGHBORS)
    distance = with_slopes(fixed, o.points, neighbors, o.mask)
    planes = fit_planes(o.points, o.mask, neighbors)
    spacing = jnp.maximum(masked_median(distance[:, 1], o.mask), MIN_GAP)
    cloud = Cloud(
        points=o.points,
        mask=o.mask,
        distance=distance,
        neighbors=neighbors,
        gap=GAP_SPACINGS * spacing,
        lowest=o.lowest,
    )
    slope = slopes(ask, o, planes.normal, neighbors)
    signs = outward_signs(cloud, planes.normal, slope, o.views)
    return OrientedPlanes(
        points=o.points,
        mask=o.mask,
        center=planes.center,
        normal=signs[:, None] * planes.normal,
        distance=distance,
        neighbors=neighbors,
        gap=cloud.gap,
        residual=planes.residual,
        noiseless=planes.noiseless,
    )


def slopes(ask: Ask, o: PaddedObject, normal: Points, neighbors: Int[Array, "n k"]) -> Float[Array, " n"]:
    """By how much the field rises along normals, −1 to 1, by its gradient at some points around."""
    row, real = evenly(o.mask.sum(), min(SAMPLES, len(o.points)))
    asked = jax.lax.stop_gradient(at_rows(o.points, row))
    gradient = jax.lax.stop_gradient(jax.grad(lambda at: ask(at).sum())(asked))
    around = at_rows(gradient, nearest_index(o.points, asked, real))
    around = at_rows(around, neighbors).sum(axis=1)
    length = jnp.maximum(jnp.linalg.norm(around, axis=1), 1e-9)
    return (jax.lax.stop_gradient(normal) * around).sum(axis=1) / length


def screened(field: Grid, planes: OrientedPlanes, o: PaddedObject, config: MeshingConfig) -> Grid:
    """Inside and outside by the screened equation, as sharp as the points have something to tell.

    That is the cube's step, or, of noisy points, half the step at which the network was asked.
    """
    finest = 2 * o.half_width / config.resolution
    resolved = planes.residual < RESOLVED_RESIDUAL * finest
    several = planes.noiseless & o.several & (config.screening_length_multi_scan > 0)
    length = jnp.where(several, config.screening_length_multi_scan or 1.0, config.screening_length)
    step = jnp.where(resolved, finest, o.half_width / asked_cells(config))
    return screened_poisson(
        field,
        planes.points,
        planes.mask,
        planes.normal,
        areas(planes),
        o.half_width,
        step,
        length,
        empty_space(config.screening_length),
    )
