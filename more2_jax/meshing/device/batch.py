"""Padded objects in one compiled call, and meshes of what it returns."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from more2_jax.config import MeshingConfig
from more2_jax.geometry.free_space import VIEWS
from more2_jax.meshing.device.isosurface import IsoSurface, iso_surface
from more2_jax.meshing.device.sides import Views
from more2_jax.meshing.device.values import PaddedObject, surface_values
from more2_jax.meshing.extract import canonical, lowest_height
from more2_jax.network.prior import Prior
from more2_jax.network.row_map import chunked
from more2_jax.types import Embedding, Mesh

SIZES = 1024, 4096, 16384  # that clouds are padded to
ROOM = 8  # crossed cells there is room for, over the cells of a side of the grid: a few times a cube's faces


def padded_object(
    embedding: Embedding,
    points: Float[np.ndarray, "n 3"],
    half_width: float,
    floor: float | None,
    several: bool,
    rise: float,
    sensors: Float[np.ndarray, "n s 3"] | None = None,
    normals: Float[np.ndarray, "n 3"] | None = None,
) -> PaddedObject:
    """One object's cloud (the scan's frame, meters, float64) in canonical units, padded to the largest size."""
    size, count = SIZES[-1], len(points)
    placed, sides = np.zeros((2, size, 3), np.float32)
    placed[:count] = canonical(embedding, points)
    eyes = np.full((size, VIEWS, 3), np.nan, np.float32)
    if sensors is not None:
        eyes[:count, : sensors.shape[1]] = canonical(embedding, sensors)
    if normals is not None:
        sides[:count] = normals
    known = np.array(sensors is not None or normals is not None)
    arrays: dict[str, Any] = {
        "points": placed,
        "mask": np.arange(size) < count,
        "views": Views(**{"sensors": eyes, "normals": sides, "known": known}),
        "half_width": np.array(half_width, np.float32),
        "lowest": np.array(lowest_height(embedding, floor), np.float32),
        "several": np.array(several),
        "rise": np.array(rise, np.float32),
    }
    return PaddedObject(embedding=dataclasses.replace(embedding, origin=None), **arrays)


def surfaces(prior: Prior, objects: list[PaddedObject], config: MeshingConfig, at_once: int) -> IsoSurface:
    """Surfaces of a batch, `at_once` in a compiled call; on the host, fewer triangles than there are room for."""
    most = max(int(o.mask.sum()) for o in objects)
    size = next(s for s in SIZES if s >= most)
    rows = jax.tree.map(lambda *x: np.stack(x), *[cut(o, size) for o in objects])
    return chunked(partial(_surfaces, prior, config=config), at_once, rows, wider=1)


def cut(o: PaddedObject, size: int) -> PaddedObject:
    """The first rows of an object."""
    views = dataclasses.replace(o.views, sensors=o.views.sensors[:size], normals=o.views.normals[:size])
    return dataclasses.replace(o, points=o.points[:size], mask=o.mask[:size], views=views)


@partial(jax.jit, static_argnames=("config",))
def _surfaces(prior: Prior, objects: PaddedObject, *, config: MeshingConfig) -> IsoSurface:
    def one(o: PaddedObject) -> IsoSurface:
        values = surface_values(prior, o, config)
        return iso_surface(values, 2 * o.half_width / config.resolution, ROOM * config.resolution**2)

    # A CPU works on one after the other and leaves out what an object does not need, as rays to sensors.
    return jax.lax.map(one, objects) if jax.default_backend() == "cpu" else jax.vmap(one)(objects)


def overflows(surface: IsoSurface) -> bool:
    """Whether one surface has more vertices or crossed cells than there is room for."""
    return max(int(surface.vertex_count), int(surface.cell_count)) > len(surface.vertices)


def placed_mesh(
    surface: IsoSurface, embedding: Embedding, half_width: float, config: MeshingConfig
) -> Mesh | None:
    """The mesh of one surface, meters in the scan's frame; None without triangles."""
    if not surface.vertex_count:
        return None
    faces = np.asarray(surface.triangles).reshape(-1, 3)
    steps = np.asarray(surface.vertices[: int(surface.vertex_count)], np.float64)
    offsets = steps * (2 * half_width / config.resolution) - half_width
    vertices = offsets * float(embedding.scale) + embedding.scan_center()
    return Mesh(vertices=vertices, faces=faces[faces[:, 0] >= 0].astype(np.int32))
