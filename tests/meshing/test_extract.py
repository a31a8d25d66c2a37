"""Iso-surfaces of fields known in closed form: on the surface, closed, of the right volume, as a dense grid gives."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from shapes import box_distance

from more2_jax.config import MeshingConfig
from more2_jax.meshing import extract as meshing
from more2_jax.meshing.extract import HALF_WIDTH, extract_mesh, observed_level
from more2_jax.meshing.grid import cube
from more2_jax.network.embedding_batch import embed
from more2_jax.types import Embedding

SCALE = 2.0  # meters per canonical unit
CENTER, ORIGIN = np.array([0.1, -0.2, 0.05]), np.array([1000.0, -2000.0, 5.0])
CONFIG = MeshingConfig(coarse_resolution=16, resolution=64)
STEP = SCALE * 2 * HALF_WIDTH / CONFIG.resolution  # meters
PIECE = Embedding(
    inv=np.zeros(4, np.float32),
    eqv=np.zeros((3, 4), np.float32),
    scale=np.float32(SCALE),
    center=CENTER.astype(np.float32),
    origin=ORIGIN,
)


def ball(p):
    return np.linalg.norm(p, axis=1) - 0.4


def box(p):
    return box_distance(p, np.array([0.45, 0.3, 0.2]))


def torus(p):
    return np.hypot(np.linalg.norm(p[:, :2], axis=1) - 0.35, p[:, 2]) - 0.1


def plate(p):
    return box_distance(p, np.array([0.45, 0.3, 0.03]))


FIELDS = {  # canonical: field, volume
    "ball": (ball, 4 / 3 * np.pi * 0.4**3),
    "box": (box, 8 * 0.45 * 0.3 * 0.2),
    "torus": (torus, 2 * np.pi**2 * 0.35 * 0.1**2),
    "plate": (plate, 8 * 0.45 * 0.3 * 0.03),
}


@pytest.fixture
def field_is(monkeypatch):
    """Puts a function of canonical points in the decoder's place; returns how many points it was asked of."""
    asked = []

    def put(field):
        def values(prior, embedding, points):
            canonical = (np.asarray(points, np.float64) - np.asarray(embedding.center)) / float(
                embedding.scale
            )
            asked.append(len(points))
            return jnp.asarray(field(canonical), jnp.float32)

        monkeypatch.setattr(meshing, "_field_values", values)
        return asked

    return put


def canonical(mesh):
    return (mesh.vertices - CENTER - ORIGIN) / SCALE


def solid(mesh):
    return trimesh.Trimesh(mesh.vertices - ORIGIN, mesh.faces, process=False)


@pytest.mark.parametrize("name", FIELDS)
def test_vertices_lie_on_the_surface_and_enclose_its_volume(field_is, tiny_prior, name):
    field, volume = FIELDS[name]
    field_is(field)
    mesh = extract_mesh(tiny_prior, PIECE, CONFIG)
    assert mesh is not None and mesh.vertices.dtype == np.float64
    assert SCALE * np.abs(field(canonical(mesh))).max() < 0.5 * STEP
    whole = solid(mesh)
    assert whole.is_watertight and whole.is_winding_consistent
    assert whole.volume == pytest.approx(volume * SCALE**3, rel=0.05)


@pytest.mark.parametrize("name", FIELDS)
def test_level_by_level_equals_the_dense_grid_with_fewer_questions(field_is, tiny_prior, name):
    asked = field_is(FIELDS[name][0])
    sparse = extract_mesh(tiny_prior, PIECE, CONFIG)
    few = sum(asked)
    dense = extract_mesh(tiny_prior, PIECE, dataclasses.replace(CONFIG, coarse_resolution=64))
    assert sparse is not None and dense is not None
    for a, b in ((sparse, dense), (dense, sparse)):
        assert cKDTree(a.vertices).query(b.vertices)[0].max() < 1e-3 * STEP
    assert few < 0.6 * (sum(asked) - few)


def test_a_field_without_zero_has_no_surface(field_is, tiny_prior):
    field_is(lambda p: np.full(len(p), 0.3))
    assert extract_mesh(tiny_prior, PIECE, CONFIG) is None


@pytest.mark.parametrize("resolution", [16, 32])
def test_a_surface_that_leaves_the_box_is_closed_at_its_border(field_is, tiny_prior, resolution):
    field_is(lambda p: np.linalg.norm(p, axis=1) - 0.8)
    whole = solid(extract_mesh(tiny_prior, PIECE, dataclasses.replace(CONFIG, resolution=resolution)))
    half = SCALE * (HALF_WIDTH + 2 * HALF_WIDTH / resolution)
    assert whole.is_watertight and whole.volume > 0
    assert (np.abs(whole.vertices - CENTER) <= half + 1e-6).all()


def test_inside_everywhere_is_the_box_itself(field_is, tiny_prior):
    field_is(lambda p: np.full(len(p), -0.3))
    whole = solid(extract_mesh(tiny_prior, PIECE, CONFIG))
    assert whole.is_watertight
    assert whole.volume == pytest.approx((2 * HALF_WIDTH * SCALE) ** 3, rel=0.1)


def test_the_box_can_be_widened(field_is, tiny_prior):
    field_is(lambda p: np.linalg.norm(p, axis=1) - 0.8)
    mesh = extract_mesh(tiny_prior, PIECE, CONFIG, half_width=1.0)
    assert solid(mesh).volume == pytest.approx(4 / 3 * np.pi * (0.8 * SCALE) ** 3, rel=0.05)


def test_another_level_is_another_surface(field_is, tiny_prior):
    field_is(ball)
    mesh = extract_mesh(tiny_prior, PIECE, CONFIG, level=0.05)
    np.testing.assert_allclose(np.linalg.norm(canonical(mesh), axis=1), 0.45, atol=2e-3)


def test_the_observed_level_is_the_median_at_the_points(field_is, tiny_prior):
    field_is(ball)
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(9001, 3))
    for bias, expected in ((0.0, 0.0), (0.03, 0.03), (0.5, 0.1), (-0.3, -0.1)):
        radius = 0.4 + bias + 0.01 * rng.normal(size=(len(ways), 1))
        points = SCALE * radius * ways / np.linalg.norm(ways, axis=1, keepdims=True) + CENTER + ORIGIN
        assert observed_level(tiny_prior, PIECE, points) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(("coarse", "resolution"), [(32, 48), (32, 16), (10, 64)])
def test_a_resolution_not_reached_by_doubling_is_refused(tiny_prior, coarse, resolution):
    config = MeshingConfig(coarse_resolution=coarse, resolution=resolution)
    with pytest.raises(
        ValueError, match=f"resolution {resolution} from coarse_resolution {coarse}; needed a power of two"
    ):
        extract_mesh(tiny_prior, PIECE, config)


def test_the_decoder_itself_gives_a_closed_mesh_or_none(tiny_prior):
    rng = np.random.default_rng(0)
    code = dataclasses.replace(
        PIECE,
        inv=rng.normal(size=16).astype(np.float32),
        eqv=rng.normal(size=(3, 16)).astype(np.float32),
    )
    config = MeshingConfig(coarse_resolution=8, resolution=16)
    values = meshing._field(tiny_prior, code, 0.0, cube(8, HALF_WIDTH).corners())
    mesh = extract_mesh(tiny_prior, code, config, level=float(np.median(values)))
    assert mesh is not None and solid(mesh).is_watertight
    assert extract_mesh(tiny_prior, code, config, level=float(values.min()) - 10.0) is None


@pytest.mark.parametrize("height", [-0.5, -0.1, 0.2])  # canonical, from the ball's center
def test_nothing_lies_below_the_floor(field_is, tiny_prior, height):
    field_is(ball)
    floor = float(CENTER[2] + ORIGIN[2] + SCALE * height)
    whole = solid(extract_mesh(tiny_prior, PIECE, CONFIG, floor=floor))
    assert whole.is_watertight and (whole.vertices[:, 2] + ORIGIN[2]).min() > floor - 1e-3
    cap = np.clip(0.4 - height, 0, 0.8)
    assert whole.volume == pytest.approx(np.pi * cap**2 * (0.4 - cap / 3) * SCALE**3, rel=0.05)


def test_a_floor_above_all_leaves_no_surface(field_is, tiny_prior):
    field_is(ball)
    assert extract_mesh(tiny_prior, PIECE, CONFIG, floor=float(ORIGIN[2] + 10)) is None


def test_a_field_asked_less_finely_is_interpolated(field_is, tiny_prior):
    asked = field_is(ball)
    every = extract_mesh(tiny_prior, PIECE, CONFIG)
    of_every = sum(asked)
    same = extract_mesh(tiny_prior, PIECE, dataclasses.replace(CONFIG, field_resolution=64))
    np.testing.assert_array_equal(every.vertices, same.vertices)
    asked.clear()
    some = extract_mesh(tiny_prior, PIECE, dataclasses.replace(CONFIG, field_resolution=32))
    assert sum(asked) < of_every / 2
    step = 2 * HALF_WIDTH / 32
    # A straight line between two points of a field of curvature c is at most c step² / 8 off, along three axes.
    most = 3 * step**2 / 8 / (0.4 - step)
    radius = np.linalg.norm(canonical(some), axis=1)
    assert 1e-4 < np.abs(radius - 0.4).max() < most
    assert solid(some).is_watertight


def test_values_do_not_depend_on_how_many_are_asked_at_once(tiny_prior):
    embedding = embed(tiny_prior, [np.random.default_rng(0).normal(size=(300, 3))])[0]
    queries = np.random.default_rng(1).uniform(-0.5, 0.5, (3000, 3))
    few = meshing._in_chunks(meshing._field_values, tiny_prior, embedding, queries[:100])
    turns = meshing._in_chunks(meshing._field_values, tiny_prior, embedding, queries)
    once = meshing._in_chunks(meshing._field_values, tiny_prior, embedding, queries, 4096)
    assert once.shape == turns.shape == (3000,) and np.ptp(once) > 1e-3
    np.testing.assert_allclose(once, turns, atol=1e-6)
    np.testing.assert_allclose(once[:100], few, atol=1e-6)
