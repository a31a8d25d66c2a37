"""Meshes of a scene's objects (paper §3.4): what was seen of each, its floor and its box, handed to extraction."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float

from more2_jax.config import SceneConfig
from more2_jax.geometry.floor import floor_height
from more2_jax.geometry.outliers import inliers
from more2_jax.meshing.extract import extract_mesh, observed_level
from more2_jax.meshing.observed_surface import some_of
from more2_jax.network.prior import Prior
from more2_jax.tracking.object_views import seen_from
from more2_jax.tracking.objects import (
    accumulated,
    accumulated_points,
)
from more2_jax.types import Mesh, ScanRecord, SceneObject

STRAYS = 0.02  # share of an object's points that may lie below the floor,
BELOW_M = 0.05  # by more than this
# About 70 MB each: a scene of eight objects took 662 MB one at a time, 1,131 MB all at once.
MESHES_AT_ONCE = 8


def floor_under(o: SceneObject, background: Float[np.ndarray, "b 3"], config: SceneConfig) -> float | None:
    """Height of the floor in an object's frame, meters; `background` is that of its reference scan.

    None if it is not asked for, there is none to see, or the object was seen clearly below it: then it is another's.
    """
    if not (config.upright and config.meshing.floor):
        return None
    floor = floor_height(background)
    if floor is None or float(np.quantile(accumulated_points(o)[:, 2], STRAYS)) < floor - BELOW_M:
        return None
    return floor


def floor_of(o: SceneObject, scans: Sequence[ScanRecord], config: SceneConfig) -> float | None:
    """`floor_under` an object in its reference scan."""
    return floor_under(o, scans[o.reference_scan].background, config)


def meshes_of(
    prior: Prior, objects: Sequence[SceneObject], scans: Sequence[ScanRecord], config: SceneConfig
) -> Iterator[Mesh | None]:
    """The objects' meshes in their order, `MESHES_AT_ONCE` worked on side by side: most steps keep one core busy."""
    with ThreadPoolExecutor(min(MESHES_AT_ONCE, os.cpu_count() or 1)) as pool:
        yield from pool.map(lambda o: mesh_of(prior, o, scans, config), objects)


def mesh_of(prior: Prior, o: SceneObject, scans: Sequence[ScanRecord], config: SceneConfig) -> Mesh | None:
    """The object's mesh, in a box that holds all that was seen of it, and above the floor of its reference scan.

    `level` "observed": seen points lie on the surface, so the field's median there is its bias, and is taken off.
    """
    points, eyes = trusted(o, scans, config)
    level = observed_level(prior, o.embedding, points) if config.meshing.level == "observed" else 0.0
    floor = floor_of(o, scans, config)
    half, meshing = box_half_width(o, config), config.meshing
    if not seen_often(o):
        meshing = dataclasses.replace(meshing, screening_of_many=0.0)
    return extract_mesh(prior, o.embedding, meshing, half, level, points, floor, eyes)


def seen_often(o: SceneObject) -> bool:
    """Whether several scans make up its shape."""
    return len(accumulated(o)) > 1


def trusted(
    o: SceneObject, scans: Sequence[ScanRecord], config: SceneConfig
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n s 3"] | None]:
    """What was seen of an object without outliers, thinned, in its frame; and from where, if that is known and used."""
    points = some_of(accumulated_points(o))
    eyes = seen_from(o, scans) if config.meshing.seen_reach else None
    most = config.meshing.outlier_factor_of_many if seen_often(o) else config.meshing.outlier_factor
    kept = inliers(points, most)
    return points[kept], None if eyes is None else some_of(eyes)[kept]


def box_half_width(o: SceneObject, config: SceneConfig) -> float:
    """Half the edge of the box to mesh, canonical units: at least the usual, and all of what was seen."""
    center = o.embedding.scan_center()
    seen = np.quantile(np.abs(accumulated_points(o) - center).max(axis=1), 0.99) / float(o.embedding.scale)
    return float(np.clip(1.15 * seen, config.meshing.half_width, 3 * config.meshing.half_width))
