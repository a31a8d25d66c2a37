"""Mesh of one accumulated object: its inlier points, its floor, its query box, then extraction (paper §3.4)."""

from __future__ import annotations

import dataclasses
import os
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from jaxtyping import Float

from more2_jax.config import SceneConfig
from more2_jax.geometry.floor import floor_height
from more2_jax.geometry.observations import seen_from
from more2_jax.geometry.open_below import openness
from more2_jax.geometry.outliers import inliers
from more2_jax.meshing.extract import HALF_WIDTH, extract_mesh, observed_level
from more2_jax.meshing.observed_surface import uniform_subsample
from more2_jax.network.prior import Prior
from more2_jax.types import AccumulatedObject, Mesh

# An object stands on another floor than the visible one where more than so many of its points lie clearly below that.
BELOW_FLOOR_SHARE = 0.02
BELOW_FLOOR_M = 0.05
# Half the query box: what was observed (but for a hundredth of stray points) and a little more, within limits.
BOX_QUANTILE = 0.99
BOX_MARGIN = 1.15
MAX_BOX = 3.0  # times the usual half width
# A scene of eight objects took 662 MB one at a time, 1,131 MB all at once.
MESHES_AT_ONCE, MESH_MB = 8, 70


def object_meshes(
    prior: Prior, objects: Iterable[AccumulatedObject], config: SceneConfig
) -> Iterator[Mesh | None]:
    """The objects' meshes in their order, as many worked on side by side as there are cores: most steps keep one busy.

    `MESHES_AT_ONCE` at most, and what `config.memory_mb` holds. Of `objects` no more are drawn than are worked on.
    """
    at_once = min(MESHES_AT_ONCE, os.cpu_count() or 1, max(1, config.memory_mb // MESH_MB))
    with ThreadPoolExecutor(at_once) as pool:
        begun = deque[Future[Mesh | None]]()
        for o in objects:
            begun.append(pool.submit(object_mesh, prior, o, config))
            if len(begun) > at_once:
                yield begun.popleft().result()
        while begun:
            yield begun.popleft().result()


def object_mesh(prior: Prior, o: AccumulatedObject, config: SceneConfig) -> Mesh | None:
    """The object's mesh in its reference frame, meters; None where its field has no surface.

    The query box holds all that was seen of the object; nothing lies below the floor it was first seen on. `level`
    "observed": seen points lie on the surface, so the field's median there is its bias, and is taken off.
    """
    meshing = config.meshing
    points, sensors, normals = inlier_points(o, config)
    level = observed_level(prior, o.embedding, points) if meshing.level == "observed" else 0.0
    if not in_several_scans(o):
        meshing = dataclasses.replace(meshing, screening_length_multi_scan=0.0)
    meshing = dataclasses.replace(meshing, unseen_rise=unseen_rise(o, config))
    half_width, floor = box_half_width(o), object_floor(o, config)
    return extract_mesh(prior, o.embedding, meshing, half_width, level, points, floor, sensors, normals)


def object_floor(o: AccumulatedObject, config: SceneConfig) -> float | None:
    """Height of the floor in an object's frame, meters, by the room it was first seen in.

    None if it is not asked for, there is none to see, or the object was seen clearly below it: then it is another's.
    """
    if not (config.upright and config.meshing.clip_to_floor):
        return None
    floor = floor_height(o.background)
    if floor is None:
        return None
    lowest = float(np.quantile(o.points[:, 2], BELOW_FLOOR_SHARE))
    return None if lowest < floor - BELOW_FLOOR_M else floor


def unseen_rise(o: AccumulatedObject, config: SceneConfig) -> float:
    """How much an object's field rises where nobody looked: what hides the floor beneath may be solid."""
    asked = config.meshing.unseen_rise
    return asked * openness(o.seen_beneath) if config.upright else 0.0


def in_several_scans(o: AccumulatedObject) -> bool:
    """Whether several scans make up its shape."""
    return len(o.poses) > 1


def inlier_points(
    o: AccumulatedObject, config: SceneConfig
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n s 3"] | None, Float[np.ndarray, "n 3"] | None]:
    """A uniform subsample of an object's points without outliers, in its frame; the sensors that may see them; normals.

    No sensors and no normals where they are not known, or not asked for.
    """
    meshing = config.meshing
    points = uniform_subsample(o.points)
    sensors = seen_from(o) if meshing.mls_bandwidth else None
    factor = meshing.outlier_factor_multi_scan if in_several_scans(o) else meshing.outlier_factor
    kept = inliers(points, factor)
    sensors = None if sensors is None else uniform_subsample(sensors)[kept]
    if o.normals is None or not meshing.mls_bandwidth:
        return points[kept], sensors, None
    return points[kept], sensors, uniform_subsample(o.normals)[kept]


def box_half_width(o: AccumulatedObject) -> float:
    """Half the edge of the query box, canonical units: at least the usual, and all of what was seen."""
    center = o.embedding.scan_center()
    reach = np.quantile(np.abs(o.points - center).max(axis=1), BOX_QUANTILE)
    return float(np.clip(BOX_MARGIN * reach / float(o.embedding.scale), HALF_WIDTH, MAX_BOX * HALF_WIDTH))
