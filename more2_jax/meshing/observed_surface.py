"""The surface where it was observed: implicit moving least squares over the points' planes, instead of the field.

Not in the paper. A code and a few hundred anchors keep a piece's shape, not the millimeters of the points they came
from. So near the points the field gives way to the distance from the planes that neighboring points lie in, and a
little farther away to the inside and outside that these planes tell (`screened_poisson.py`). Farther off the field
alone goes on: what nobody saw is still completed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int, Real
from scipy.spatial import KDTree

from more2_jax.geometry.poses import Points
from more2_jax.meshing.grid import Grid, Lattice
from more2_jax.meshing.normal_orientation import outward_signs
from more2_jax.meshing.planes import face_normals, fit_planes
from more2_jax.meshing.screened_poisson import screened_poisson, surface_areas

# The values behind the tables of docs/developing/notebook/mesh_sides.md and mesh_edges.md; lengths in canonical units.
PLANE_NEIGHBORS = 12  # points of a plane
MIN_POINTS = PLANE_NEIGHBORS + 1  # fewer make no surface
MAX_POINTS = 16_384  # more are thinned
NOISELESS = 0.1  # residual of the planes, as a share of their points' spread: with less, edges are kept sharp
QUERY_PLANES = 8  # that a query is measured to: those of the nearest point and of that point's neighbors
QUERY_PLANES_NOISELESS = 4  # without noise there is less to average
GAP_SPACINGS = 3.0  # a plane holds this many median point distances along it
MIN_GAP = 1e-3  # where points are doubled
RESOLVED_RESIDUAL = 0.15  # share of a grid's step: points rougher than this do not resolve it
CUTOFF = 1.5  # bandwidths off a plane, and gaps along it, beyond which it has no weight
QUERIES_AT_ONCE = 1024  # measured together: what is known of their planes stays in the caches
NOT_FACING = 1e-30  # a cosine that is none, or negative
FACING_POWER = 4  # of the cosine to the nearest plane's normal: the other face of a thin board has no weight


@dataclass(frozen=True)
class ObservedSurface:
    """Oriented planes through neighboring points; canonical units, relative to the object's center."""

    tree: KDTree  # of the points the planes belong to
    center: Points  # of each plane: its points' mean, which has less of their noise, or the point where there is none
    normal: Points  # unit length, outward
    distance: Float[np.ndarray, "_ k"]  # of every point to its neighbors, nearest first,
    neighbors: Int[np.ndarray, "_ k"]  # and which these are
    bandwidth: float  # off a plane, at this distance, its weight has fallen to 1/e
    gap: float  # and along it, at this distance from the nearest point: it also holds between neighbors
    residual: float  # how far off the planes their points lie, typically
    noiseless: bool  # so little that noise does not show

    @property
    def points(self) -> Points:
        """What was observed."""
        return np.asarray(self.tree.data)

    @property
    def cutoff(self) -> float:
        """Farther than this from any point the field is unchanged."""
        return CUTOFF * float(np.hypot(self.bandwidth, self.gap))

    def resolves(self, step: float) -> bool:
        """Whether the points have so little noise that a grid of this step has something to tell."""
        return self.residual < RESOLVED_RESIDUAL * step

    def corrected(
        self, queries: Points, field: Float[np.ndarray, " _"], reach: float = np.inf
    ) -> Float[np.ndarray, " _"]:
        """Field values at queries, drawn toward the signed distance from the planes; canonical units.

        Queries farther than `reach` from all points are left as they are, as those beyond `cutoff` always.
        """
        result = np.array(field, np.float64)
        # Most of a grid is out of reach, and stays as it is.
        distance, nearest = self.tree.query(queries, distance_upper_bound=min(reach, self.cutoff))
        near = np.flatnonzero(distance < np.inf)
        if not len(near):
            return result
        for start in range(0, len(near), QUERIES_AT_ONCE):
            some = near[start : start + QUERIES_AT_ONCE]
            result[some] = self._toward_planes(queries[some], nearest[some], result[some])
        return result

    def _toward_planes(
        self, queries: Points, nearest: Int[np.ndarray, " q"], field: Float[np.ndarray, " q"]
    ) -> Float[np.ndarray, " q"]:
        """`corrected` of queries within reach, `nearest` to these points."""
        x, y, z = (queries - self.points[nearest]).T
        planes = np.take(self.query_planes, nearest, axis=2)
        signed, weight = (p[0] * x + p[1] * y + p[2] * z + p[3] for p in (planes[:4], planes[4:]))
        np.exp(weight, out=weight)
        plane = (weight * signed).sum(axis=0) / weight.sum(axis=0)
        # Flat at first: a field whose surface is a centimeter off must not draw this one toward it.
        along = np.maximum(x**2 + y**2 + z**2 - plane**2, 0.0)
        share = np.exp(-((plane / self.bandwidth) ** 4) - (along / self.gap**2) ** 2)
        return field + share * (plane - field)

    def sign_reach(self, least: float) -> float:
        """So far from all points, at most, a field whose absolute value is `least` or more can change its sign.

        The result lies between the field and the height over the planes. Of opposite sign it is only where that height
        h has a share s ≥ f / (f + h), which bounds first h and then, given h, the distance along the planes.
        """
        height = np.linspace(0.0, 2.0 * self.bandwidth, 1000)
        left = np.log1p(height / least) - (height / self.bandwidth) ** 4
        reach = np.where(left >= 0, height**2 + self.gap**2 * np.sqrt(np.maximum(left, 0.0)), 0.0)
        return float(np.sqrt(reach.max())) + float(height[1])

    @cached_property
    def query_planes(self) -> Float[np.ndarray, "8 k n"]:
        """Of every point, the planes that a query nearest to it is measured to: its own, and those of its neighbors.

        Two linear functions of a query's offset from the point, each as x, y, z and constant: the height over the
        plane, and the logarithm of its weight, where near ones count and those that face as the point's own does; up
        to what is the same for all planes.
        """
        near = self.neighbors[:, : QUERY_PLANES_NOISELESS if self.noiseless else QUERY_PLANES].T.copy()
        near[0] = np.arange(near.shape[1])  # where points are doubled, the first may be another
        normal, toward = self.normal[near], self.points[near] - self.points
        height = np.einsum("kni,kni->kn", normal, self.points - self.center[near])
        facing = np.einsum("kni,ni->kn", normal, self.normal)
        facing = FACING_POWER * np.log(np.maximum(facing, NOT_FACING))
        closeness = facing - 0.5 * (toward**2).sum(axis=2) / self.gap**2
        parts = [*np.moveaxis(normal, 2, 0), height, *np.moveaxis(toward, 2, 0) / self.gap**2, closeness]
        return np.stack(parts)

    def screened(self, field: Grid, lattice: Lattice, length: float, margin: float) -> Grid:
        """The field on a lattice, inside and outside corrected near the points; `length`: how far that reaches."""
        return screened_poisson(field, lattice, self.points, self.normal, self.areas, length, margin)

    @cached_property
    def areas(self) -> Float[np.ndarray, " n"]:
        """The share of the surface each point stands for."""
        return surface_areas(self.points, self.normal, self.distance, self.neighbors)


def uniform_subsample(rows: Real[np.ndarray, "n *_"], most: int = MAX_POINTS) -> Real[np.ndarray, "m *_"]:
    """At most `most` of the rows, at even steps from the first to the last."""
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(int)]


def fit_observed_surface(
    points: Points,
    gradient: Points,
    bandwidth: float,
    lowest: float = -np.inf,
    sensors: Float[np.ndarray, "p s 3"] | None = None,
    normals: Points | None = None,
) -> ObservedSurface | None:
    """Planes through each point's neighbors, oriented outward. None if there are too few points.

    `gradient` of the field at the points has a vote in what is outward; one of the positions `sensors` saw a point, if
    they are known (NaN fills up); the scan says that it faces along `normals` (zeros where it does not say). All in
    canonical units, relative to the object's center. Below the height `lowest` there is no free space.
    """
    if len(points) < MIN_POINTS:
        return None
    tree = KDTree(points)
    distance, neighbors = map(np.asarray, tree.query(points, k=PLANE_NEIGHBORS))
    planes = fit_planes(points, neighbors)
    residual = float(np.sqrt(max(0.0, np.median(planes.residual_variance))))
    noiseless = residual < NOISELESS * float(np.sqrt(np.median(planes.total_variance)))
    center, normal = planes.center, planes.normal
    if noiseless:
        center, normal = points, face_normals(points, neighbors, planes.normal)
    around = gradient[neighbors].sum(axis=1)
    slope = np.einsum("ni,ni->n", normal, around) / np.maximum(np.linalg.norm(around, axis=1), 1e-9)
    gap = GAP_SPACINGS * max(float(np.median(distance[:, 1])), MIN_GAP)
    signs = outward_signs(tree, normal, slope, gap, lowest, sensors, (distance, neighbors), normals)
    normal = signs[:, None] * normal
    return ObservedSurface(tree, center, normal, distance, neighbors, bandwidth, gap, residual, noiseless)
