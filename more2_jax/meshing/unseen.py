"""Where nobody looked, the field must be sure to be inside.

Not in the paper. A field learned from distances is, where it does not know, a mean of what may be there: below a
tabletop that was seen from above it goes on as a solid. So it rises with the distance from what was observed, but not
where the observed faces turn their backs from all sides: that is the inside of a body, whatever the field says. How
much they surround a place is the generalized winding number (Barill et al. 2018): 1 within a closed surface, 0 far
from any, a half just below a face. What may be solid keeps its field: the floor beneath tells (`open_below`).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from more2_jax.geometry.poses import Points
from more2_jax.meshing.observed_surface import ObservedSurface, uniform_subsample

RISE_REACH = 0.05  # canonical units, over which the field rises
# Spacings of the points: no place between them is farther from all, where they lie in squares.
BETWEEN = np.sqrt(0.5)
FULL_RISE = 0.5  # winding number up to which it rises fully; from there less and less, at 1 not at all
WINDING_POINTS = 2048  # at most, that the winding number is asked of
QUERIES_AT_ONCE = 512  # their distances from all points stay in the caches


def raised(
    surface: ObservedSurface, queries: Points, field: Float[np.ndarray, " q"], rise: float
) -> Float[np.ndarray, " q"]:
    """Field values plus `rise` times the distance from what was observed, `RISE_REACH` at most; canonical units.

    What lies between neighboring points was observed. What is inside by the field rises the less, the more the observed
    faces surround it.
    """
    if not rise:
        return field
    between = BETWEEN * float(
        np.sqrt(np.median(surface.areas))
    )  # a point stands for the square of the spacing
    distance, _ = surface.tree.query(queries, distance_upper_bound=between + RISE_REACH)
    risen = rise * np.clip(distance - between, 0.0, RISE_REACH)
    inside = np.flatnonzero(field < 0)
    count = len(surface.points)
    # Of fewer points each stands for more.
    area = uniform_subsample(surface.areas, WINDING_POINTS) * (count / min(count, WINDING_POINTS))
    points, normals = (uniform_subsample(x, WINDING_POINTS) for x in (surface.points, surface.normal))
    risen[inside] *= share_of_rise(winding_number(queries[inside], points, normals, area))
    return field + risen


def share_of_rise(winding: Float[np.ndarray, " q"]) -> Float[np.ndarray, " q"]:
    """1 up to the winding number `FULL_RISE`, 0 where it is 1 or more."""
    return np.clip((1.0 - winding) / (1.0 - FULL_RISE), 0.0, 1.0)


def winding_number(
    queries: Points, points: Points, normals: Points, area: Float[np.ndarray, " p"]
) -> Float[np.ndarray, " q"]:
    """How often the faces around oriented points surround each query: Σ area · normal · offset / (4π distance³).

    A point within its own disc is taken to lie on the rim, where the sum stays bounded.
    """
    found = np.empty(len(queries))
    own, squared = np.einsum("pi,pi->p", points, normals), (points**2).sum(axis=1)
    rim, weight = area / np.pi, area / (4 * np.pi)
    for start in range(0, len(queries), QUERIES_AT_ONCE):
        q = queries[start : start + QUERIES_AT_ONCE]
        apart = np.maximum(squared + (q**2).sum(axis=1)[:, None] - 2 * (q @ points.T), rim)
        found[start : start + QUERIES_AT_ONCE] = ((own - q @ normals.T) / (apart * np.sqrt(apart))) @ weight
    return found
