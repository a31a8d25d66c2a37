"""Normals of a cloud that has none, where its sensors are known: across the surface, on the side that was seen."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Integer

from more2_jax.geometry.room_planes import across

Points = Float[np.ndarray, "n 3"]
SIDEWAYS = 0.1  # cosine: a sensor that sees a surface so nearly along it does not tell its side
FEWEST = 12  # points of an object: fewer have no surface


def seen_normals(
    points: Points, instance: Integer[np.ndarray, " n"], sensors: Float[np.ndarray, "s 3"]
) -> Points:
    """Unit normals of every instance's points, out of the matter; all in one frame and unit.

    Zeros where they are not known: of the background (`instance` ≤ 0), and where sensors stand on both sides of a
    surface, as any of them may have seen it.
    """
    normals = np.zeros_like(points)
    for i in np.unique(instance[instance > 0]):
        rows = np.flatnonzero(instance == i)
        if len(rows) >= FEWEST:
            normals[rows] = facing(points[rows], across(points[rows], points[rows]), sensors)
    return normals


def facing(points: Points, normals: Points, sensors: Float[np.ndarray, "s 3"]) -> Points:
    """The normals turned to the sensors; zeros where some stand on either side, or all along the surface."""
    toward = sensors[None] - points[:, None]
    length = np.maximum(np.linalg.norm(toward, axis=-1), 1e-12)
    cosine = np.einsum("nsi,ni->ns", toward, normals) / length
    before, behind = (cosine > SIDEWAYS).any(axis=1), (cosine < -SIDEWAYS).any(axis=1)
    return normals * (before.astype(float) - behind.astype(float))[:, None]
