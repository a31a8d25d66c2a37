"""Which side of its surfaces a scan's normals are on: meshes are wound either way, clouds are oriented by guess."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Integer

Points = Float[np.ndarray, "n 3"]
LEAST_KNOWN = 16  # normals of the background: fewer do not tell
LEAST_FACING = 0.1  # mean cosine: below it the faces are wound at random, and their normals have no side


def outward(
    points: Points, normals: Points, instance: Integer[np.ndarray, "n"], sensors: Float[np.ndarray, "s 3"]
) -> tuple[Points | None, bool]:
    """The normals out of the matter, all turned around where they point into it; and whether they did.

    A scan sees surfaces from free space. Sensors tell best; else floor and walls, which face the middle of the room;
    else the objects, whose surfaces face away from their middles. `instance` ≤ 0: background. None for normals that
    have no common side.
    """
    known = (normals != 0).any(axis=1)
    if len(sensors):
        cosine = _toward(points, normals, sensors.mean(axis=0))[known]
    elif (background := known & (instance <= 0)).sum() >= LEAST_KNOWN:
        cosine = _toward(points, normals, 0.5 * (points.min(axis=0) + points.max(axis=0)))[background]
    else:
        cosine = -np.concatenate([np.zeros(0), *_of_objects(points, normals, instance, known)])
    facing = float(cosine.mean()) if len(cosine) else 0.0
    if abs(facing) < LEAST_FACING:
        return None, False
    return (-normals, True) if facing < 0 else (normals, False)


def _of_objects(
    points: Points, normals: Points, instance: Integer[np.ndarray, "n"], known: Bool[np.ndarray, " n"]
) -> Iterator[Float[np.ndarray, " k"]]:
    """Of every object, the cosines of its normals to its middle."""
    for i in np.unique(instance[instance > 0]):
        rows = instance == i
        yield _toward(points[rows], normals[rows], points[rows].mean(axis=0))[known[rows]]


def _toward(points: Points, normals: Points, place: Float[np.ndarray, "3"]) -> Float[np.ndarray, " n"]:
    """Cosines of the normals to the direction of a place."""
    toward = place - points
    length = np.linalg.norm(toward, axis=1)
    return np.einsum("ni,ni->n", normals, toward) / np.maximum(length, 1e-12)
