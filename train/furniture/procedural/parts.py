"""Closed solids that furniture is made of: boards, posts, tubes, turned and lofted parts, cushions.

Lengths are meters, z is up; `at` is the middle of a part's underside unless it says otherwise. Parts that are
to become one piece overlap by `BITE`.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from manifold3d import Manifold

Rng = np.random.Generator
Point = tuple[float, float, float]
Outline = Float[np.ndarray, "n 2"]

BITE = 0.006  # how far a part reaches into the one that carries it
ROUND = 20  # sides of a circle


def kernel() -> ModuleType:
    """manifold3d. Raises ValueError where it is not installed."""
    try:
        import manifold3d
    except ImportError as error:
        raise ValueError("procedural furniture needs manifold3d; install the extra `data`") from error
    return manifold3d


def union(parts: Sequence[Manifold]) -> Manifold:
    """What any of the parts fills."""
    return kernel().Manifold.batch_boolean(list(parts), kernel().OpType.Add)


# --- straight -----------------------------------------------------------------------------------------------


def box(x: float, y: float, z: float, at: Point = (0, 0, 0)) -> Manifold:
    """A box of edges x, y, z."""
    return kernel().Manifold.cube((x, y, z), False).translate((at[0] - x / 2, at[1] - y / 2, at[2]))


def between(low: Point, high: Point) -> Manifold:
    """The box of two opposite corners."""
    edges = [b - a for a, b in zip(low, high, strict=True)]
    return kernel().Manifold.cube(edges, False).translate(low)


def pole(radius: float, length: float, at: Point = (0, 0, 0), top: float | None = None) -> Manifold:
    """An upright cylinder, or a cone that ends in the radius `top`."""
    return kernel().Manifold.cylinder(length, radius, radius if top is None else top, ROUND).translate(at)


def ring(thickness: float, sides: int, at: Point) -> Float[np.ndarray, "n 3"]:
    """A horizontal polygon of a width across its flats, for `post` and `loft`; four sides lie along x and y."""
    angle = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    radius = thickness / 2 / np.cos(np.pi / sides)
    flat = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.column_stack([flat, np.zeros(sides)]) + at


def post(foot: Point, head: Point, thick_foot: float, thick_head: float, sides: int = 4) -> Manifold:
    """A straight leg from foot to head, tapered, possibly leaning, cut level at both ends."""
    rings = np.concatenate([ring(thick_foot, sides, foot), ring(thick_head, sides, head)])
    return kernel().Manifold.hull_points(rings)


def bar(a: Point, b: Point, radius: float, radius_b: float | None = None) -> Manifold:
    """A rod from a to b with round ends."""
    return tube([a, b], [radius, radius if radius_b is None else radius_b])


def tube(points: Sequence[Point], radius: float | Sequence[float]) -> Manifold:
    """A rod through the points, a ball in every joint."""
    radii = np.broadcast_to(np.asarray(radius, float), len(points))
    balls = [kernel().Manifold.sphere(r, 12).translate(p) for r, p in zip(radii, points, strict=True)]
    hull = kernel().Manifold.batch_hull
    return union([hull([one, other]) for one, other in itertools.pairwise(balls)])


def bent(points: Sequence[Point], bend: float, steps: int = 4) -> list[Point]:
    """The same path with its inner corners rounded: quadratic curves that begin `bend` before each corner."""
    path = [np.asarray(p, float) for p in points]
    out = [path[0]]
    for before, corner, after in zip(path, path[1:], path[2:], strict=False):
        arms = [before - corner, after - corner]
        ends = [
            corner + arm / np.linalg.norm(arm) * min(bend, 0.49 * float(np.linalg.norm(arm))) for arm in arms
        ]
        for t in np.linspace(0, 1, steps):
            out.append((1 - t) ** 2 * ends[0] + 2 * t * (1 - t) * corner + t**2 * ends[1])
    out.append(path[-1])
    return [(float(p[0]), float(p[1]), float(p[2])) for p in out]


# --- flat ---------------------------------------------------------------------------------------------------


def superellipse(x: float, y: float, squareness: float, count: int = 40) -> Outline:
    """A convex outline in x × y: an ellipse for squareness 2, nearly a rectangle for 10."""
    angle = (np.arange(count) + 0.5) * 2 * np.pi / count
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    size = (np.abs(circle) ** squareness).sum(axis=1) ** (1 / squareness)
    unit = circle / size[:, None]
    return unit / np.abs(unit).max(axis=0) * (x / 2, y / 2)


def rounded(x: float, y: float, radius: float) -> Outline:
    """A rectangle x × y with round corners; radius 0 leaves them sharp."""
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    if radius <= 0:
        return corners * (x / 2, y / 2)
    radius = min(radius, 0.49 * x, 0.49 * y)
    angle = np.linspace(0, np.pi / 2, 6)[None] + np.arange(4)[:, None] * np.pi / 2
    arcs = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return (arcs + (corners * (x / 2 - radius, y / 2 - radius))[:, None]).reshape(-1, 2)


def slab(outline: Outline, thickness: float, at: Point = (0, 0, 0), bevel: float = 0.0) -> Manifold:
    """A level board of a convex outline, its lower edge drawn in by `bevel`."""
    narrow = 1 - 2 * bevel / np.ptp(outline, axis=0)
    edge = min(bevel, 0.6 * thickness)
    layers = [(outline * narrow, 0.0), (outline, edge), (outline, thickness)]
    points = [np.column_stack([flat, np.full(len(flat), z)]) for flat, z in layers]
    return kernel().Manifold.hull_points(np.concatenate(points) + at)


def sheared(solid: Manifold, lean: float, above: float) -> Manifold:
    """Leans backwards (toward +y) by `lean` meters a meter above the height `above`."""
    return solid.transform(np.array([[1, 0, 0, 0], [0, 1, lean, -lean * above], [0, 0, 1, 0]], float))


def curved(solid: Manifold, bow: float, width: float, edge: float = 0.045) -> Manifold:
    """Bows a part that is wide along x: its middle moves toward +y by `bow`, its ends stay."""

    def bend(points: np.ndarray) -> np.ndarray:
        shift = bow * (1 - (2 * points[:, :1] / width) ** 2)
        return points + shift * (0, 1, 0)

    return solid.refine_to_length(edge).warp_batch(bend)


# --- round --------------------------------------------------------------------------------------------------


def turned(profile: Sequence[tuple[float, float]], at: Point = (0, 0, 0), sides: int = ROUND) -> Manifold:
    """A part of the lathe: the polygon (radius, height) turned about the upright axis through `at`."""
    section = kernel().CrossSection([np.asarray(profile, float)], kernel().FillRule.EvenOdd)
    return section.revolve(sides).translate(at)


def soft_box(x: float, y: float, z: float, at: Point, radius: float) -> Manifold:
    """A box with all its edges rounded."""
    radius = min(radius, 0.49 * x, 0.49 * y, 0.49 * z)
    ball = kernel().Manifold.sphere(radius, 16)
    reach = (x / 2 - radius, y / 2 - radius)
    corners = [
        (a * reach[0], b * reach[1], c) for a in (-1, 1) for b in (-1, 1) for c in (radius, z - radius)
    ]
    return kernel().Manifold.batch_hull([ball.translate(c) for c in corners]).translate(at)


def cushion(
    x: float,
    y: float,
    z: float,
    at: Point,
    squareness: float = 5.0,
    crown: float = 2.5,
    pinch: float = 0.0,
    detail: int = 40,
) -> Manifold:
    """A superellipsoid of edges x, y, z: `squareness` in plan, `crown` upright; 2 is an ellipsoid, 8 a box.

    `pinch` draws the middles of its sides in, by that share, as stuffing does to a pillow's corners.
    """

    def swell(points: np.ndarray) -> np.ndarray:
        plan = (np.abs(points[:, :2]) ** squareness).sum(axis=1) ** (1 / squareness)
        size = (plan**crown + np.abs(points[:, 2]) ** crown) ** (1 / crown)
        out = points / size[:, None]
        corner = np.minimum(np.abs(out[:, 0]), np.abs(out[:, 1]))
        out[:, :2] *= (1 - pinch * (1 - corner))[:, None]
        return out * (x / 2, y / 2, z / 2) + (at[0], at[1], at[2] + z / 2)

    return kernel().Manifold.sphere(1.0, detail).warp_batch(swell)


def dimpled(solid: Manifold, spots: Float[np.ndarray, "n 3"], depth: float, spread: float) -> Manifold:
    """Buttons pulled into upholstery: the surface near each spot moves away from it, `depth` at most."""

    def pull(points: np.ndarray) -> np.ndarray:
        away = points[:, None] - spots
        near = np.exp(-((away / spread) ** 2).sum(axis=-1))
        inward = points.mean(axis=0) - spots
        inward /= np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-9)
        return points + depth * (near[..., None] * inward).sum(axis=1)

    return solid.warp_batch(pull)
