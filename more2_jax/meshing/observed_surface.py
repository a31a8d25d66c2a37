"""The surface where it was seen: beside observed points they, not the code, say where it runs.

Beyond the paper. A code and a few hundred anchors keep a piece's shape, not the millimeters of the points they came
from. So near them the field gives way to the distance from the planes that neighboring points lie in (implicit
moving least squares), and a little farther away to the sides that these planes have (`screened_poisson.py`). Farther
off the field alone goes on: what nobody saw is still completed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from more2_jax.geometry.poses import Points
from more2_jax.meshing.grid import Grid, Lattice
from more2_jax.meshing.normal_orientation import outward_signs
from more2_jax.meshing.planes import planes_of
from more2_jax.meshing.screened_poisson import areas, screened

NEIGHBORS = 12  # points of a plane
EXACT = 0.1  # share of their own spread: points that lie off their planes by less are exact, and their edges are sharp
ASKED = 8  # planes a query hears, of the point nearest to it and of that point's neighbors,
ASKED_OF_EXACT = 4  # fewer where noise need not be averaged away
MOST = 16_384  # points that are kept
GAP = 3.0  # median distances between neighbors
LEAST_GAP = 1e-3  # canonical units; where points are doubled
FEWEST = NEIGHBORS + 1  # fewer make no surface
SMOOTH = 0.15  # share of a grid's step: points rougher than this do not resolve it
FARTHEST = 1.5  # reaches from a plane, and gaps along it, beyond which it has no say
ONE_FACE = 4  # power of the cosine to the nearest plane's normal: the other face of a thin board is not heard


@dataclass(frozen=True)
class SeenSurface:
    """Planes through neighboring points, oriented; canonical units, relative to the object's center."""

    tree: KDTree  # of the points the planes belong to
    center: Points  # of each plane: its points' mean, which has less of their noise, or the point if that is exact
    normal: Points  # unit length, outward
    area: Float[np.ndarray, " _"]  # the share of the surface that each stands for
    neighbors: Int[np.ndarray, "_ k"]  # of every point, nearest first
    reach: float  # off a plane, at this distance, its say has fallen to 1/e
    gap: float  # and along it, at this distance from the nearest point: it also holds between neighbors
    roughness: float  # how far off the planes their points lie, typically
    exact: bool  # so little that noise does not show

    @property
    def points(self) -> Points:
        """What was seen."""
        return np.asarray(self.tree.data)

    @property
    def farthest(self) -> float:
        """From a seen point, what lies farther away is not drawn."""
        return FARTHEST * float(np.hypot(self.reach, self.gap))

    def resolves(self, step: float) -> bool:
        """Whether the points are so exact that a grid of this step has something to tell."""
        return self.roughness < SMOOTH * step

    def corrected(self, queries: Points, field: Float[np.ndarray, " _"]) -> Float[np.ndarray, " _"]:
        """Field values at queries, drawn toward the distance from the planes; signed, canonical units."""
        result = np.array(field, np.float64)
        # Most of a grid is out of reach, and stays as it is.
        distance, nearest = self.tree.query(queries, distance_upper_bound=self.farthest)
        near = np.flatnonzero(distance < np.inf)
        if not len(near):
            return result
        way = queries[near] - self.points[nearest[near]]
        normal, toward, height, agree = np.split(self.planes[nearest[near]], (3, 6, 7), axis=2)
        offset = np.einsum("qi,qki->qk", way, normal) + height[..., 0]
        squared = ((way[:, None] - toward) ** 2).sum(axis=2)
        closeness = np.exp(-0.5 * (squared - squared[:, :1]) / self.gap**2) * agree[..., 0]
        plane = (closeness * offset).sum(axis=1) / closeness.sum(axis=1)
        # Flat at first: a field whose surface is a centimeter off must not draw this one toward it.
        along = np.maximum(squared[:, 0] - plane**2, 0.0)
        say = np.exp(-((plane / self.reach) ** 4) - (along / self.gap**2) ** 2)
        result[near] += say * (plane - result[near])
        return result

    @cached_property
    def planes(self) -> Float[np.ndarray, "n k 8"]:
        """Of every point, the planes that a query nearest to it hears: its own, and those of its neighbors.

        Normal, way to the neighbor, height of the point over the neighbor's plane, how far the two face alike.
        """
        near = self.neighbors[:, : ASKED_OF_EXACT if self.exact else ASKED].copy()
        near[:, 0] = np.arange(len(near))  # where points are doubled, the first may be another
        normal, toward = self.normal[near], self.points[near] - self.points[:, None]
        height = np.einsum("nki,nki->nk", normal, self.points[:, None] - self.center[near])
        agree = np.maximum(np.einsum("nki,ni->nk", normal, self.normal), 0.0) ** ONE_FACE
        return np.concatenate([normal, toward, np.stack([height, agree], axis=2)], axis=2)

    def screened(self, field: Grid, lattice: Lattice, length: float, margin: float) -> Grid:
        """The field on a lattice, its sides near what was seen put right; `length`: how far that reaches."""
        return screened(field, lattice, self.points, self.normal, self.area, length, margin)


def some_of(points: Float[np.ndarray, "n *_"], most: int = MOST) -> Float[np.ndarray, "m *_"]:
    """At most `most` of the points, or of what belongs to them, at even steps."""
    return points[np.linspace(0, len(points) - 1, min(len(points), most)).astype(int)]


def seen_surface(
    points: Points,
    slope: Points,
    reach: float,
    lowest: float = -np.inf,
    seen_from: Float[np.ndarray, "p s 3"] | None = None,
) -> SeenSurface | None:
    """Planes through each point's neighbors, outward. None if there are too few points.

    `slope` is the field's gradient at the points, which has a say in what is outward; one of the places `seen_from`
    saw a point, if they are known (NaN fills up). All in canonical units, relative to the object's center. Below the
    height `lowest` there is no free space.
    """
    if len(points) < FEWEST:
        return None
    tree = KDTree(points)
    apart, neighbors = map(np.asarray, tree.query(points, k=NEIGHBORS))
    found = planes_of(points, neighbors)
    roughness = float(np.sqrt(max(0.0, np.median(found.off))))
    exact = roughness < EXACT * float(np.sqrt(np.median(found.spread)))
    center, normal = map(np.asarray, (points, found.face) if exact else (found.center, found.normal))
    around = slope[neighbors].sum(axis=1)
    rise = np.einsum("ni,ni->n", normal, around) / np.maximum(np.linalg.norm(around, axis=1), 1e-9)
    gap = GAP * max(float(np.median(apart[:, 1])), LEAST_GAP)
    signs = outward_signs(tree, normal, rise, gap, lowest, seen_from, (apart, neighbors))
    normal = signs[:, None] * normal
    area = areas(points, normal, apart, neighbors)
    return SeenSurface(tree, center, normal, area, neighbors, reach, gap, roughness, exact)
