"""Mesh of one object from its code (paper §3.4): multi-resolution iso-surface extraction, then marching cubes."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from functools import partial

import jax
import numpy as np
from jax import Array
from jaxtyping import Float
from scipy.spatial import KDTree
from skimage.measure import marching_cubes

from more2_jax.config import MeshingConfig
from more2_jax.geometry.poses import Points
from more2_jax.meshing.grid import (
    Grid,
    GridField,
    Lattice,
    Mask,
    crossed_corners,
    cube,
    surface_cells,
    upsampled,
)
from more2_jax.meshing.observed_surface import ObservedSurface, fit_observed_surface, uniform_subsample
from more2_jax.meshing.screened_poisson import empty_space
from more2_jax.meshing.unseen import raised
from more2_jax.network.prior import Prior, sdf_one
from more2_jax.types import Embedding, Mesh

HALF_WIDTH = 0.65  # of the query box, canonical units. Objects are turned in it, so more than half of their edge of 0.9
MAX_LEVEL = 0.1  # canonical units: a field that is farther off at observed points is wrong, not biased

# Queries a call: one compiled program for every object and resolution. On a CPU the layers' values should stay in the
# caches (2,048 take 0.6 times as long as 8,192 at a time); accelerators want large products where there is much to ask.
CHUNK = 2048
ACCELERATOR_CHUNK = 32768
GRADIENT_CHUNK = 512  # the same of gradients on CPUs: a cloud seen by one scan asks at few points
SURE_CELLS = 0.6  # of a field whose value is so many steps of its grid, few points change the sign
SAMPLES = CHUNK  # points at most where the field's level, and its gradient, are asked

# Of one object at `CHUNK` points. Differences of values instead of a gradient would spare a compilation, but at the
# field's kinks some 0.3 % of a noisy cloud's points then face the other way, and meshes move by millimeters.
_field_values = jax.jit(sdf_one)
_field_gradients = jax.jit(jax.grad(lambda *asked: sdf_one(*asked).sum(), argnums=2))


Field = Callable[[Points], Float[np.ndarray, " p"]]  # the network's at points,
Values = Callable[[Points, Float[np.ndarray, " p"]], Float[np.ndarray, " p"]]  # and the surface's, given that


def extract_mesh(
    prior: Prior,
    embedding: Embedding,
    config: MeshingConfig,
    half_width: float = HALF_WIDTH,
    level: float = 0.0,
    seen: Float[np.ndarray, "n 3"] | None = None,
    floor: float | None = None,
    seen_from: Float[np.ndarray, "n s 3"] | None = None,
    normals: Float[np.ndarray, "n 3"] | None = None,
) -> Mesh | None:
    """A level set of one object's field, by default 0; meters in its scan's frame, always closed (paper §3.4).

    `half_width` (canonical units) is half the edge of the query box. `seen` are points of the surface in the scan's
    frame; with a `config.mls_bandwidth` the surface runs through them. `seen_from` are the sensor positions that each
    was seen from, if known (NaN fills up), and `normals` where it faces (zeros if not known). Nothing lies below the
    height `floor`. Returns None if the field stays above `level` in the box. Raises ValueError unless `resolution` is
    `coarse_resolution` times a power of two.
    """
    check_resolutions(config)
    lowest = lowest_height(embedding, floor)
    surface = observed_surface(prior, embedding, seen, config, lowest, seen_from, normals)
    field = partial(_raised, prior, embedding, level, surface, config.unseen_rise)
    values = partial(_corrected, surface, lowest)
    found = _sampled(field, values, cube(config.coarse_resolution, half_width))
    asked = config.field_resolution or config.resolution
    while (cells := round(2 * half_width / found.lattice.step)) < config.resolution:
        if surface is not None and config.screening_length and cells == asked:
            found = _screened(surface, config, lowest, found, 2 * half_width / config.resolution)
        else:
            found = _refined(field if 2 * cells <= asked else None, values, found)
    if not (found.values < 0).any():
        return None
    return _marching_cubes(found, embedding)


def observed_level(prior: Prior, embedding: Embedding, points: Float[np.ndarray, "n 3"]) -> float:
    """The field's median at points (scan's frame) known to lie on the surface, canonical units; 0.1 at most."""
    values = _field(prior, embedding, 0.0, canonical(embedding, uniform_subsample(points, SAMPLES)))
    return float(np.clip(np.median(values), -MAX_LEVEL, MAX_LEVEL))


def observed_surface(
    prior: Prior,
    embedding: Embedding,
    observed: Float[np.ndarray, "n 3"] | None,
    config: MeshingConfig,
    lowest: float = -np.inf,
    sensors: Float[np.ndarray, "n s 3"] | None = None,
    normals: Float[np.ndarray, "n 3"] | None = None,
    samples: int = SAMPLES,
) -> ObservedSurface | None:
    """Oriented planes around observed points (scan's frame). None if there are none, or the settings ask for none.

    The field's slope, one vote of several for a plane's outer side, is asked at `samples` points at most.
    """
    if observed is None or not config.mls_bandwidth:
        return None
    points = canonical(embedding, uniform_subsample(observed))
    eyes = None if sensors is None else canonical(embedding, uniform_subsample(sensors))
    asked = uniform_subsample(points, samples)
    slopes = _in_chunks(_field_gradients, prior, embedding, asked, GRADIENT_CHUNK)
    gradient = slopes[KDTree(asked).query(points)[1]]
    sides = None if normals is None else uniform_subsample(normals)
    return fit_observed_surface(points, gradient, config.mls_bandwidth, lowest, eyes, sides)


def canonical(embedding: Embedding, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Points of the scan's frame in canonical units, relative to the object's center."""
    return (points - embedding.scan_center()) / float(embedding.scale)


def lowest_height(embedding: Embedding, floor: float | None) -> float:
    """A floor's height (meters, the scan's frame) in canonical units, relative to the center; −∞ if there is none."""
    return -np.inf if floor is None else float(canonical(embedding, np.array([[0.0, 0.0, floor]]))[0, 2])


def check_resolutions(config: MeshingConfig) -> None:
    """Raises ValueError unless the last grid is the first one with its step halved some times."""
    doublings = np.log2(config.resolution / config.coarse_resolution)
    if doublings < 0 or doublings != int(doublings):
        raise ValueError(
            f"resolution {config.resolution} from coarse_resolution {config.coarse_resolution}; "
            "needed a power of two times it"
        )


def _field(prior: Prior, embedding: Embedding, level: float, queries: Points) -> Float[np.ndarray, " p"]:
    """The field at canonical offsets from the center, less `level`."""
    return _in_chunks(_field_values, prior, embedding, queries) - level


def _raised(
    prior: Prior,
    embedding: Embedding,
    level: float,
    surface: ObservedSurface | None,
    rise: float,
    queries: Points,
) -> Float[np.ndarray, " p"]:
    """The field less `level`, raised where nothing was observed."""
    field = _field(prior, embedding, level, queries)
    return field if surface is None else raised(surface, queries, field, rise)


def _in_chunks(
    program: Callable[[Prior, Embedding, np.ndarray], Array],
    prior: Prior,
    embedding: Embedding,
    queries: Points,
    chunk: int = CHUNK,
) -> Float[np.ndarray, "p *_"]:
    """What a program gives at canonical offsets, asked for in chunks of a fixed size: `chunk` on CPUs.

    On accelerators one for few, one for many.
    """
    local = dataclasses.replace(embedding, origin=np.zeros(3, np.float32))
    points = (queries * float(embedding.scale) + np.asarray(embedding.center)).astype(np.float32)
    if jax.default_backend() != "cpu":
        chunk = ACCELERATOR_CHUNK if len(points) > CHUNK else CHUNK
    padded = np.zeros((-(-max(len(points), 1) // chunk) * chunk, 3), np.float32)
    padded[: len(points)] = points
    parts = [program(prior, local, part) for part in padded.reshape(-1, chunk, 3)]
    return np.concatenate(jax.device_get(parts))[: len(points)]


def _corrected(
    surface: ObservedSurface | None, lowest: float, queries: Points, field: Float[np.ndarray, " p"]
) -> Float[np.ndarray, " p"]:
    """The field drawn toward what was observed, and positive below `lowest`."""
    values = field if surface is None else surface.corrected(queries, field)
    return np.maximum(values, lowest - queries[:, 2])


def _sampled(field: Field, values: Values, lattice: Lattice) -> GridField:
    """The field and the values at all corners."""
    queries = lattice.corners()
    known = field(queries)
    drawn = values(queries, known)
    return GridField(lattice, known.reshape(lattice.shape), drawn.reshape(lattice.shape))


def _refined(field: Field | None, values: Values, coarse: GridField) -> GridField:
    """Field and values on the grid with half the step: new near the surface, interpolated elsewhere.

    Without `field` it is interpolated there too, and only the correction is made anew.
    """
    near = surface_cells(coarse.values, coarse.lattice.step)
    finer = coarse.finer()
    new = np.zeros(finer.lattice.shape, bool)
    corners = 2 * np.argwhere(near)
    for step in itertools.product(range(3), repeat=3):
        new[tuple((corners + step).T)] = True
    new[::2, ::2, ::2] = False  # known from the coarse grid
    queries = finer.lattice.at(np.argwhere(new))
    if field is not None:
        finer.field[new] = field(queries)
    finer.values[new] = values(queries, finer.field[new])
    return finer


def _screened(
    surface: ObservedSurface, config: MeshingConfig, lowest: float, coarse: GridField, finest: float
) -> GridField:
    """Field and values on a finer grid, inside and outside by the screened Poisson equation near observed points.

    With half the step, or the step `finest` if the points have so little noise; of the box alone that holds what is
    inside and what was observed.
    """
    held = coarse.lattice.corners_near(surface.points, 0.5 * coarse.lattice.step)
    length = (surface.noiseless and config.screening_length_multi_scan) or config.screening_length
    # The same space around it for either length: more costs time and, measured, changes nothing.
    margin = empty_space(config.screening_length)
    box = coarse.around(held | (coarse.field < 0), margin)
    step = finest if surface.resolves(finest) else box.lattice.step / 2
    lattice, field = box.lattice, box.field
    while lattice.step > 1.5 * step:
        lattice, field = lattice.finer(), upsampled(field)
    below = lowest - lattice.low[2] - lattice.step * np.arange(lattice.shape[2])
    field = surface.screened(np.maximum(field, below), lattice, length, margin)
    final = lattice.step < 1.5 * finest
    return GridField(lattice, field, _drawn_near(surface, lattice, field, below, final))


def _drawn_near(
    surface: ObservedSurface, lattice: Lattice, field: Grid, below: Float[np.ndarray, " k"], final: bool
) -> Grid:
    """The field on a lattice drawn toward what was observed, and positive below a height.

    `final`: only the corners of cells that the surface crosses need be exact, of the others the sign. Most corners are
    then farther off than a sign can change.
    """
    near, values = lattice.corners_near(surface.points, surface.cutoff), field.copy()

    def draw(asked: Mask, reach: float = np.inf) -> None:
        values[asked] = surface.corrected(lattice.at(np.argwhere(asked)), field[asked], reach)

    if not final:
        draw(near)
        return np.maximum(values, below)
    least = SURE_CELLS * lattice.step
    reach, sure = surface.sign_reach(least), np.abs(field) >= least
    exact = near & ~sure
    draw(exact)
    draw(near & sure & lattice.corners_near(surface.points, reach), reach)
    drawn = np.maximum(values, below)
    # At the border the surface is closed by values that are not of this field.
    open_ended = any((np.take(drawn, (0, -1), axis=axis) < 0).any() for axis in range(3))
    draw(near & ~exact if open_ended else near & ~exact & crossed_corners(drawn))
    return np.maximum(values, below)


def _marching_cubes(found: GridField, embedding: Embedding) -> Mesh:
    # A ring of outside around the box closes surfaces that reach its border.
    lattice, values = found.lattice, found.values
    padded = np.pad(values, 1, constant_values=max(float(values.max()), lattice.step))
    vertices, faces, _, _ = marching_cubes(padded, 0.0, gradient_direction="descent")
    offsets = lattice.at(vertices - 1)
    placed = offsets * float(embedding.scale) + embedding.scan_center()
    return Mesh(vertices=placed.astype(np.float64), faces=faces.astype(np.int32))
