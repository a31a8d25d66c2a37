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
from jaxtyping import Bool, Float
from scipy.ndimage import binary_dilation
from scipy.spatial import KDTree
from skimage.measure import marching_cubes

from more2_jax.config import MeshingConfig
from more2_jax.prior import Prior, sdf_one
from more2_jax.seen_surface import SeenSurface, seen_surface, some_of
from more2_jax.types import Embedding, Mesh

# Queries a call: one compiled program for every object and resolution. On a CPU the layers' values should stay in the
# caches (2048 take 0.6 times as long as 8192 at a time); accelerators want large products.
CHUNK = {"cpu": 2048}
CHUNK_OF_OTHERS = 32768
SLOPES = 4096  # points at most where the field's slope is asked; it has little to say at the others either
OBSERVED = 4096  # and where its level is

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
    """A level set of one object's field, by default 0; metres in its scan's frame, always closed.

    `half_width` (canonical units) is half the edge of the query box. With `seen`, points of the surface in the
    scan's frame, and a `config.seen_reach`, the surface runs through them; each was seen from one of the places
    `seen_from` (NaN fills up), if they are known. Nothing lies below the height `floor` of that frame. Returns None
    when the field stays above `level` in the box: there is no surface to show. Raises ValueError unless
    `resolution` is `coarse` doubled some times.
    """
    _check(config)
    half = half_width or config.half_width
    lowest = -np.inf if floor is None else canonical(embedding, np.array([[0.0, 0.0, floor]]))[0, 2]
    through = surface_through(prior, embedding, seen, config, lowest, seen_from)
    ask = partial(_field, prior, embedding, level)
    draw = partial(_drawn, through, lowest)
    first = _grid(config.coarse, half)
    shape = [config.coarse + 1] * 3
    field = ask(first)
    values, field = draw(first, field).reshape(shape), field.reshape(shape)
    asked = config.field_resolution or config.resolution
    while len(values) - 1 < config.resolution:
        if through is not None and config.screening and len(values) - 1 == asked:
            field, values = _sided(through, config, lowest, field, half)
        else:
            finer = ask if 2 * (len(values) - 1) <= asked else None
            field, values = _refine(finer, draw, field, values, half)
    if not (values < 0).any():
        return None
    return _surface(values, embedding, 2 * half / (len(values) - 1), half)


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
    slope = _in_chunks(_slopes, prior, embedding, asked)[KDTree(asked).query(points, workers=-1)[1]]
    return seen_surface(points, slope, config.seen_reach, lowest, eyes)


def observed_level(prior: Prior, embedding: Embedding, points: Float[np.ndarray, "n 3"]) -> float:
    """The field's median at points (scan's frame) known to lie on the surface, canonical units; 0.1 at most."""
    values = _field(prior, embedding, 0.0, canonical(embedding, some_of(points, OBSERVED)))
    return float(np.clip(np.median(values), -0.1, 0.1))


def canonical(embedding: Embedding, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Points of the scan's frame in canonical units, relative to the object's centre."""
    return (points - np.asarray(embedding.center, np.float64) - embedding.origin) / float(embedding.scale)


def _grid(cells: int, half: float) -> Float[np.ndarray, "p 3"]:
    axis = np.linspace(-half, half, cells + 1)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)


def _field(
    prior: Prior, embedding: Embedding, level: float, queries: Float[np.ndarray, "p 3"]
) -> Float[np.ndarray, " p"]:
    """Field at canonical offsets from the centre, less `level`."""
    return _in_chunks(_values, prior, embedding, queries) - level


def _drawn(
    seen: SeenSurface | None,
    lowest: float,
    queries: Float[np.ndarray, "p 3"],
    field: Float[np.ndarray, " p"],
) -> Float[np.ndarray, " p"]:
    """The field drawn towards what was seen, and above `lowest`."""
    values = field if seen is None else seen.corrected(queries, field)
    return np.maximum(values, lowest - queries[:, 2])


def _in_chunks(
    of: Callable[[Prior, Embedding, Array], Array],
    prior: Prior,
    embedding: Embedding,
    queries: Float[np.ndarray, "p 3"],
) -> Float[np.ndarray, "p *_"]:
    """What `of` gives at canonical offsets, asked for in chunks of one fixed size."""
    local = dataclasses.replace(embedding, origin=jnp.zeros(3))
    points = (queries * float(embedding.scale) + np.asarray(embedding.center)).astype(np.float32)
    chunk = CHUNK.get(jax.default_backend(), CHUNK_OF_OTHERS)
    padded = np.zeros((-(-max(len(points), 1) // chunk) * chunk, 3), np.float32)
    padded[: len(points)] = points
    parts = [of(prior, local, jnp.asarray(part)) for part in padded.reshape(-1, chunk, 3)]
    return np.concatenate(jax.device_get(parts))[: len(points)]


def _refine(
    ask: Callable[[Float[np.ndarray, "p 3"]], Float[np.ndarray, " p"]] | None,
    draw: Callable[[Float[np.ndarray, "p 3"], Float[np.ndarray, " p"]], Float[np.ndarray, " p"]],
    field: Float[np.ndarray, "n n n"],
    values: Float[np.ndarray, "n n n"],
    half: float,
) -> tuple[Float[np.ndarray, "m m m"], Float[np.ndarray, "m m m"]]:
    """Field and values on the grid with half the step: new near the surface, interpolated elsewhere.

    Without `ask` the field is interpolated there too, and only what was seen draws it anew.
    """
    cells = 2 * (len(values) - 1)
    near = near_surface(values, 2 * half / (len(values) - 1))
    field, values = doubled(field), doubled(values)
    fine = np.zeros([cells + 1] * 3, bool)
    corners = 2 * np.argwhere(near)
    for step in itertools.product(range(3), repeat=3):
        fine[tuple((corners + step).T)] = True
    fine[::2, ::2, ::2] = False  # known from the coarse grid
    queries = np.argwhere(fine) * (2 * half / cells) - half
    if ask is not None:
        field[fine] = ask(queries)
    values[fine] = draw(queries, field[fine])
    return field, values


def _sided(
    through: SeenSurface,
    config: MeshingConfig,
    lowest: float,
    field: Float[np.ndarray, "n n n"],
    half: float,
) -> tuple[Float[np.ndarray, "m m m"], Float[np.ndarray, "m m m"]]:
    """Field and values on a finer grid: inside and outside as what was seen has them, near it.

    With half the step, or the last grid's if what was seen is exact enough for it.
    """
    exact = through.resolves(2 * half / config.resolution)
    cells = config.resolution if exact else 2 * (len(field) - 1)
    while len(field) - 1 < cells:
        field = doubled(field)
    below = lowest - np.linspace(-half, half, cells + 1)
    field = through.screened(np.maximum(field, below), half, config.screening)
    near, values = through.near(half, cells), field.copy()
    values[near] = through.corrected(np.argwhere(near) * (2 * half / cells) - half, field[near])
    return field, np.maximum(values, below)


def doubled(x: Float[np.ndarray, "n n n"]) -> Float[np.ndarray, "m m m"]:
    """Linear interpolation to half the step: `scipy.ndimage.zoom`, which takes eight times as long."""
    for axis in (2, 1, 0):
        shape = list(x.shape)
        shape[axis] = 2 * shape[axis] - 1
        finer = np.empty(shape, x.dtype)
        old, new = np.moveaxis(x, axis, 0), np.moveaxis(finer, axis, 0)  # views
        new[::2] = old
        new[1::2] = (old[:-1] + old[1:]) / 2
        x = finer
    return x


def near_surface(values: Float[np.ndarray, "n n n"], cell: float) -> Bool[np.ndarray, "c c c"]:
    """Cells whose corners differ in sign, or are nearer to the surface than the cell's diagonal: a thin leg may
    pass between corners. One ring of cells more, since the field is only nearly a distance."""
    n = len(values) - 1
    offsets = itertools.product((0, 1), repeat=3)
    corners = np.stack([values[i : i + n, j : j + n, k : k + n] for i, j, k in offsets])
    straddles = (corners.min(axis=0) < 0) & (corners.max(axis=0) >= 0)
    close = np.abs(corners).min(axis=0) < 0.5 * np.sqrt(3) * cell
    return binary_dilation(straddles) | close


def _surface(values: Float[np.ndarray, "m m m"], embedding: Embedding, step: float, half: float) -> Mesh:
    # A ring of outside around the box closes surfaces that reach its border.
    padded = np.pad(values, 1, constant_values=max(float(values.max()), step))
    vertices, faces, _, _ = marching_cubes(padded, 0.0, gradient_direction="descent")
    offsets = (vertices - 1) * step - half
    origin = np.asarray(embedding.origin, np.float64)
    placed = offsets * float(embedding.scale) + np.asarray(embedding.center, np.float64) + origin
    return Mesh(vertices=placed.astype(np.float64), faces=faces.astype(np.int64))
