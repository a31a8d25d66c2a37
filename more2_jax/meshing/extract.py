"""Mesh of one object from its code (paper §3.4): multi-resolution iso-surface extraction, marching cubes."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from scipy.spatial import KDTree
from skimage.measure import marching_cubes

from more2_jax.config import MeshingConfig
from more2_jax.meshing.grid import Lattice, Level, cube, doubled, near_surface
from more2_jax.meshing.observed_surface import SeenSurface, seen_surface, some_of
from more2_jax.network.prior import Prior, sdf_one
from more2_jax.types import Embedding, Mesh

# Queries a call: one compiled program for every object and resolution. On a CPU the layers' values should stay in the
# caches (2048 take 0.6 times as long as 8192 at a time); accelerators want large products where there is much to ask.
FEW = 2048
CHUNK = {"cpu": FEW}
CHUNK_OF_OTHERS = 32768
SLOPES = FEW  # points at most where the field's slope is asked; it has little to say at the others either
OBSERVED = FEW  # and where its level is

Ask = Callable[[Float[np.ndarray, "p 3"]], Float[np.ndarray, " p"]]  # the field at queries,
Draw = Callable[
    [Float[np.ndarray, "p 3"], Float[np.ndarray, " p"]], Float[np.ndarray, " p"]
]  # and values by it

_values = jax.jit(sdf_one)
_slopes = jax.jit(jax.grad(lambda *asked: sdf_one(*asked).sum(), argnums=2))


def extract_mesh(
    prior: Prior,
    embedding: Embedding,
    config: MeshingConfig,
    half_width: float | None = None,
    level: float = 0.0,
    seen: Float[np.ndarray, "n 3"] | None = None,
    floor: float | None = None,
    seen_from: Float[np.ndarray, "n s 3"] | None = None,
) -> Mesh | None:
    """A level set of one object's field, by default 0; meters in its scan's frame, always closed.

    `half_width` (canonical units) is half the edge of the query box. With `seen`, points of the surface in the
    scan's frame, and a `config.seen_reach`, the surface runs through them; each was seen from one of the places
    `seen_from` (NaN fills up), if they are known. Nothing lies below the height `floor` of that frame. Returns None
    when the field stays above `level` in the box: there is no surface to show. Raises ValueError unless
    `resolution` is `coarse` doubled some times.
    """
    _check(config)
    half = half_width or config.half_width
    lowest = lowest_height(embedding, floor)
    through = surface_through(prior, embedding, seen, config, lowest, seen_from)
    ask = partial(_field, prior, embedding, level)
    draw = partial(_drawn, through, lowest)
    found = _first(ask, draw, cube(config.coarse, half))
    asked = config.field_resolution or config.resolution
    while (cells := round(2 * half / found.lattice.step)) < config.resolution:
        if through is not None and config.screening and cells == asked:
            found = _sided(through, config, lowest, found, 2 * half / config.resolution)
        else:
            found = _refine(ask if 2 * cells <= asked else None, draw, found)
    if not (found.values < 0).any():
        return None
    return _surface(found, embedding)


def _check(config: MeshingConfig) -> None:
    doublings = np.log2(config.resolution / config.coarse)
    if doublings < 0 or doublings != int(doublings):
        raise ValueError(
            f"resolution {config.resolution} from coarse {config.coarse}; needed a power of two times it"
        )


def surface_through(
    prior: Prior,
    embedding: Embedding,
    seen: Float[np.ndarray, "n 3"] | None,
    config: MeshingConfig,
    lowest: float = -np.inf,
    seen_from: Float[np.ndarray, "n s 3"] | None = None,
) -> SeenSurface | None:
    """What was seen, as planes around the points. None if nothing was, or it is not asked for."""
    if seen is None or not config.seen_reach:
        return None
    points = canonical(embedding, some_of(seen))
    eyes = None if seen_from is None else canonical(embedding, some_of(seen_from))
    asked = some_of(points, SLOPES)
    slope = _in_chunks(_slopes, prior, embedding, asked)[KDTree(asked).query(points)[1]]
    return seen_surface(points, slope, config.seen_reach, lowest, eyes)


def observed_level(prior: Prior, embedding: Embedding, points: Float[np.ndarray, "n 3"]) -> float:
    """The field's median at points (scan's frame) known to lie on the surface, canonical units; 0.1 at most."""
    values = _field(prior, embedding, 0.0, canonical(embedding, some_of(points, OBSERVED)))
    return float(np.clip(np.median(values), -0.1, 0.1))


def canonical(embedding: Embedding, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Points of the scan's frame in canonical units, relative to the object's center."""
    return (points - embedding.scan_center()) / float(embedding.scale)


def lowest_height(embedding: Embedding, floor: float | None) -> float:
    """A floor's height (meters, the scan's frame) in canonical units, relative to the center; −∞ if there is none."""
    return -np.inf if floor is None else float(canonical(embedding, np.array([[0.0, 0.0, floor]]))[0, 2])


def _field(
    prior: Prior, embedding: Embedding, level: float, queries: Float[np.ndarray, "p 3"]
) -> Float[np.ndarray, " p"]:
    """Field at canonical offsets from the center, less `level`."""
    return _in_chunks(_values, prior, embedding, queries) - level


def _drawn(
    seen: SeenSurface | None,
    lowest: float,
    queries: Float[np.ndarray, "p 3"],
    field: Float[np.ndarray, " p"],
) -> Float[np.ndarray, " p"]:
    """The field drawn toward what was seen, and above `lowest`."""
    values = field if seen is None else seen.corrected(queries, field)
    return np.maximum(values, lowest - queries[:, 2])


def _in_chunks(
    of: Callable[[Prior, Embedding, Array], Array],
    prior: Prior,
    embedding: Embedding,
    queries: Float[np.ndarray, "p 3"],
) -> Float[np.ndarray, "p *_"]:
    """What `of` gives at canonical offsets, asked for in chunks of a fixed size: one for few, one for many."""
    local = dataclasses.replace(embedding, origin=None)
    points = (queries * float(embedding.scale) + np.asarray(embedding.center)).astype(np.float32)
    chunk = FEW if len(points) <= FEW else CHUNK.get(jax.default_backend(), CHUNK_OF_OTHERS)
    padded = np.zeros((-(-max(len(points), 1) // chunk) * chunk, 3), np.float32)
    padded[: len(points)] = points
    parts = [of(prior, local, jnp.asarray(part)) for part in padded.reshape(-1, chunk, 3)]
    return np.concatenate(jax.device_get(parts))[: len(points)]


def _first(ask: Ask, draw: Draw, lattice: Lattice) -> Level:
    """The field and the values at all corners."""
    queries = lattice.corners()
    field = ask(queries)
    values = draw(queries, field)
    return Level(lattice, field.reshape(lattice.shape), values.reshape(lattice.shape))


def _refine(ask: Ask | None, draw: Draw, level: Level) -> Level:
    """Field and values on the grid with half the step: new near the surface, interpolated elsewhere.

    Without `ask` the field is interpolated there too, and only what was seen draws it anew.
    """
    near = near_surface(level.values, level.lattice.step)
    finer = level.finer()
    fine = np.zeros(finer.lattice.shape, bool)
    corners = 2 * np.argwhere(near)
    for step in itertools.product(range(3), repeat=3):
        fine[tuple((corners + step).T)] = True
    fine[::2, ::2, ::2] = False  # known from the coarse grid
    queries = finer.lattice.at(np.argwhere(fine))
    if ask is not None:
        finer.field[fine] = ask(queries)
    finer.values[fine] = draw(queries, finer.field[fine])
    return finer


def _sided(through: SeenSurface, config: MeshingConfig, lowest: float, level: Level, finest: float) -> Level:
    """Field and values on a finer grid: inside and outside as what was seen has them, near it.

    With half the step, or the step `finest` if what was seen is exact enough for it; of the box alone that holds
    what is inside and what was seen.
    """
    seen = level.lattice.near(through.points, 0.0)
    length = (through.exact and config.screening_of_many) or config.screening
    # The same space around it for either length: more costs time and, measured, changes nothing.
    level = level.around(seen | (level.field < 0), config.screening)
    step = finest if through.resolves(finest) else level.lattice.step / 2
    lattice, field = level.lattice, level.field
    while lattice.step > 1.5 * step:
        lattice, field = lattice.finer(), doubled(field)
    below = lowest - lattice.low[2] - lattice.step * np.arange(lattice.shape[2])
    field = through.screened(np.maximum(field, below), lattice, length, config.screening)
    near, values = lattice.near(through.points, through.farthest), field.copy()
    values[near] = through.corrected(lattice.at(np.argwhere(near)), field[near])
    return Level(lattice, field, np.maximum(values, below))


def _surface(level: Level, embedding: Embedding) -> Mesh:
    # A ring of outside around the box closes surfaces that reach its border.
    lattice, values = level.lattice, level.values
    padded = np.pad(values, 1, constant_values=max(float(values.max()), lattice.step))
    vertices, faces, _, _ = marching_cubes(padded, 0.0, gradient_direction="descent")
    offsets = lattice.at(vertices - 1)
    placed = offsets * float(embedding.scale) + embedding.scan_center()
    return Mesh(vertices=placed.astype(np.float64), faces=faces.astype(np.int64))
