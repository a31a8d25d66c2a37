"""Meshes of many objects on the device: the host's, closed, whatever else is in the call; programs do not pile up."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from more2_jax.config import MeshingConfig, preset
from more2_jax.meshing import engine
from more2_jax.meshing.device import batch
from more2_jax.meshing.device.values import surface_values
from more2_jax.meshing.engine import as_row, device_meshes, meshes_of_objects, on_device
from more2_jax.meshing.object_mesh import object_mesh
from more2_jax.network.embedding_batch import embed
from more2_jax.network.prior import load_prior
from more2_jax.scans.demo import demo_scan_paths
from more2_jax.scans.read_scan import read_scan
from more2_jax.types import AccumulatedObject

ROBUST = preset("robust", upright=True)
WORLD_M = np.array([1000.0, -2000.0, 5.0])


def with_meshing(**changes):
    return dataclasses.replace(ROBUST, meshing=dataclasses.replace(ROBUST.meshing, **changes))


CONFIG = with_meshing(resolution=64)
LITTLE = with_meshing(coarse_resolution=8, field_resolution=8, resolution=16)


def box_points(count, seed=0, noise=0.0, half=(0.5, 0.3, 0.4)):
    rng = np.random.default_rng(seed)
    face, points = rng.integers(0, 6, count), rng.uniform(-1, 1, (count, 3))
    points[np.arange(count), face // 2] = np.where(face % 2, 1.0, -1.0)
    return points * half + noise * rng.normal(size=(count, 3))


def accumulated(prior, points, scans=1, **known):
    placed = points + WORLD_M
    return AccumulatedObject(
        points=placed,
        observation=np.arange(len(points)) % scans,
        poses=np.tile(np.eye(4), (scans, 1, 1)),
        embedding=embed(prior, [placed])[0],
        **{"sensors": (np.zeros((0, 3)),) * scans} | known,
    )


@pytest.fixture(scope="module")
def prior():
    """Trained: of random weights' field only what is near its surface is the same, and that is everywhere."""
    return load_prior("small")


@pytest.fixture(scope="module")
def hard(prior):
    """Objects that are unlike one another, and unlike a good scan."""
    up = np.tile([0.0, 0.0, 1.0], (600, 1))
    plane = np.random.default_rng(3).uniform(-0.5, 0.5, (600, 3)) * [1, 1, 0]
    floor = np.random.default_rng(4).uniform(-3, 3, (4000, 3)) * [1, 1, 0] - [0, 0, 0.36] + WORLD_M
    upper = box_points(1800, 7)
    upper = upper[upper[:, 2] > 0.1]  # nobody saw what is below
    eyes = (np.array([[3.0, 0, 1], [0, -3, 1]]) + WORLD_M, np.array([[-3.0, 1, 1]]) + WORLD_M)
    make = functools.partial(accumulated, prior)
    return {
        "box": make(box_points(900)),
        "noisy": make(box_points(900, 1, 0.02), 3),
        "sensors": make(box_points(800, 2), 2, sensors=eyes),
        "plane with normals": make(plane, normals=up),
        "five points": make(box_points(5)),
        "fifteen points": make(box_points(15)),
        "doubled": make(np.repeat(box_points(300), 2, axis=0)),
        "one place": make(np.zeros((40, 3)) + [0.1, 0.0, 0.0]),
        "floor": make(box_points(700, 5), background=floor),
        "large": make(box_points(2000, 6, 0.01), 2),
        "on legs": make(upper, 2, seen_beneath=1.0),
    }


def solid(mesh, place):
    return trimesh.Trimesh(mesh.vertices - place, mesh.faces, process=False)


def apart_cm(a, b):
    """Mean distance of a's points from b's triangles, by planes of near samples; and the worst 1 %."""
    p, _ = trimesh.sample.sample_surface(a, 8000, seed=0)
    q, face = trimesh.sample.sample_surface(b, 80_000, seed=1)
    near = KDTree(q).query(p)[1]
    off = 100 * np.abs(np.einsum("ni,ni->n", p - q[near], b.face_normals[face[near]]))
    return off.mean(), np.quantile(off, 0.99)


def assert_same(host, device, place, mean_cm, volume):
    a, b = solid(host, place), solid(device, place)
    assert b.is_watertight and b.is_winding_consistent
    assert max(apart_cm(a, b)[0], apart_cm(b, a)[0]) < mean_cm
    assert b.volume == pytest.approx(a.volume, rel=volume)


# Twice the same places: of planes through three of them, which fits best is rounding.
MEAN_CM = {"doubled": 0.3}
SHEETS = ("fifteen points",)  # 1.5 cm thick: of cells of 2 cm their volume says little
NAMES = [
    "box",
    "noisy",
    "sensors",
    "plane with normals",
    "five points",
    "fifteen points",
    "doubled",
    "one place",
]
NAMES += ["floor", "large", "on legs"]


@pytest.fixture(scope="module")
def made(prior, hard):
    return dict(zip(hard, device_meshes(prior, hard.values(), CONFIG), strict=True))


@pytest.mark.parametrize("name", NAMES)
def test_meshes_are_the_hosts(prior, hard, made, name):
    expected, found = object_mesh(prior, hard[name], CONFIG), made[name]
    if name in SHEETS:
        expected, (found,) = (
            object_mesh(prior, hard[name], ROBUST),
            device_meshes(prior, [hard[name]], ROBUST),
        )
    assert len(hard) == len(NAMES) and (found is None) == (expected is None) == (name == "one place")
    if expected is not None:
        assert_same(expected, found, WORLD_M, MEAN_CM.get(name, 0.1), 0.015)


def test_the_unseen_part_of_what_is_on_legs_is_smaller(prior, hard, made):
    solid_below = dataclasses.replace(hard["on legs"], seen_beneath=0.0)
    (expected,) = device_meshes(prior, [solid_below], CONFIG)
    assert solid(made["on legs"], WORLD_M).volume < 0.98 * solid(expected, WORLD_M).volume


def test_nothing_lies_below_the_floor(hard, made):
    assert made["floor"].vertices[:, 2].min() > WORLD_M[2] - 0.36 - 0.01
    assert made["box"].vertices[:, 2].min() < WORLD_M[2] - 0.39


@pytest.mark.slow
def test_objects_of_the_demo_have_the_hosts_meshes(prior):
    """One scan's clouds as they are; and the same three times, as of several scans; in the cells of `robust`."""
    scan = read_scan(demo_scan_paths()[0])
    for n, instance in enumerate(scan.instances[:3]):
        scans = 3 if n % 2 else 1
        shape = (scans, *instance.points.shape)
        clouds = instance.points + 0.001 * np.random.default_rng(n).normal(size=shape)
        points = np.concatenate(clouds)[:: scans + 4]
        o = accumulated(prior, points - WORLD_M, scans, background=scan.background, seen_beneath=float(n < 2))
        (found,) = device_meshes(prior, [o], ROBUST)
        expected = object_mesh(prior, o, ROBUST)
        assert expected is not None and found is not None
        assert_same(expected, found, points.mean(axis=0), 0.15, 0.03)


@pytest.mark.slow
def test_programs_are_as_many_as_sizes(prior, hard, made):
    """Whatever the scene: clouds of other sizes, with sensors or normals or without, with a floor or without."""
    before = batch._surfaces._cache_size()
    for count, like in ((30, "box"), (333, "floor"), (1024, "sensors"), (3000, "noisy")):
        o, points = hard[like], box_points(count, count) + WORLD_M
        observation = np.arange(count) % len(o.poses)
        list(device_meshes(prior, [dataclasses.replace(o, points=points, observation=observation)], CONFIG))
    assert batch._surfaces._cache_size() == before >= 2


@pytest.fixture(scope="module")
def noisy_boxes(tiny_prior):
    return [accumulated(tiny_prior, box_points(n, n, 0.01), 2) for n in (200, 500, 700, 1000)]


@pytest.fixture(scope="module")
def alone(tiny_prior, noisy_boxes):
    """Each in a call of its own."""
    return list(device_meshes(tiny_prior, noisy_boxes, LITTLE))


def assert_equal(found, expected):
    """Vertices to a thousandth of a cell: of random weights the box is 80 m wide, and rounding grows with it."""
    np.testing.assert_array_equal(found.faces, expected.faces)
    cell_m = np.ptp(expected.vertices, axis=0).max() / LITTLE.meshing.resolution
    np.testing.assert_allclose(found.vertices, expected.vertices, rtol=0, atol=1e-3 * cell_m)


def meshes_of(surfaces, objects):
    taken = [jax.tree.map(lambda x, n=n: np.asarray(x[n]), surfaces) for n in range(len(objects))]
    rows = [as_row(o, LITTLE) for o in objects]
    return [
        batch.placed_mesh(s, o.embedding, float(r.half_width), LITTLE.meshing)
        for s, o, r in zip(taken, objects, rows, strict=True)
    ]


@pytest.mark.slow
def test_neither_padding_nor_order_nor_company_changes_a_mesh(tiny_prior, noisy_boxes, alone):
    backward = [as_row(o, LITTLE) for o in noisy_boxes[::-1]]
    together = batch.surfaces(tiny_prior, backward, LITTLE.meshing, 4)
    wide = jax.tree.map(lambda *x: jnp.stack(x), *[batch.cut(o, 2048) for o in backward[:1]])
    padded = batch._surfaces(tiny_prior, wide, config=LITTLE.meshing)
    for expected, found in zip(alone, meshes_of(together, noisy_boxes[::-1])[::-1], strict=True):
        assert len(expected.vertices) > 100
        assert_equal(found, expected)
    assert_equal(meshes_of(padded, noisy_boxes[-1:])[0], alone[-1])


@pytest.mark.slow
def test_an_accelerator_makes_them_side_by_side(tiny_prior, noisy_boxes, alone, monkeypatch):
    """As its programs are written: rows mapped over at once, fillers left out, no more drawn than memory holds."""
    drawn, config = [], dataclasses.replace(LITTLE, memory_mb=3 * engine.OBJECT_MB + 1)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    jax.clear_caches()  # or the CPU's program is taken
    objects = (drawn.append(o) or o for o in noisy_boxes)
    for n, mesh in enumerate(meshes_of_objects(tiny_prior, objects, config)):
        assert len(drawn) == (3 if n < 3 else 4)
        assert_equal(mesh, alone[n])
    assert n == 3
    jax.clear_caches()


@pytest.mark.slow
def test_what_there_is_no_room_for_is_made_on_the_host(tiny_prior, noisy_boxes, alone, monkeypatch):
    """`IsoSurface` tells (`test_device_isosurface`); here the second has too little."""
    most = sorted(len(m.vertices) for m in alone[:2])
    monkeypatch.setattr(engine, "overflows", lambda s: int(s.vertex_count) == len(alone[1].vertices))
    found = list(device_meshes(tiny_prior, noisy_boxes[:2], LITTLE))
    assert most[0] != most[1]
    assert_equal(found[0], alone[0])
    np.testing.assert_array_equal(found[1].vertices, object_mesh(tiny_prior, noisy_boxes[1], LITTLE).vertices)


@pytest.mark.parametrize(
    ("chosen", "backend", "device"),
    [
        ("auto", "cpu", False),
        ("auto", "gpu", True),
        ("auto", "tpu", True),
        ("host", "gpu", False),
        ("device", "cpu", True),
    ],
)
def test_the_backend_decides_unless_settings_do(monkeypatch, chosen, backend, device):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    assert on_device(MeshingConfig(engine=chosen)) is device
    assert MeshingConfig().engine == ROBUST.meshing.engine == "auto"


def test_a_resolution_not_reached_by_doubling_is_refused(tiny_prior):
    with pytest.raises(ValueError, match="needed a power of two"):
        next(device_meshes(tiny_prior, [], with_meshing(resolution=48)))


@jax.jit
def slopes(prior, o):
    def total(points):
        values = surface_values(prior, dataclasses.replace(o, points=points), LITTLE.meshing)
        return jnp.square(values).sum()

    return jax.grad(total)(o.points)


@pytest.mark.parametrize("cloud", ["box", "plane", "doubled", "one place"])
def test_values_have_a_gradient_with_respect_to_points(tiny_prior, noisy_boxes, cloud):
    points = {
        "box": box_points(150, 1, 0.01),
        "plane": box_points(150, 1) * [1, 1, 0],
        "doubled": np.repeat(box_points(75, 1), 2, axis=0),
        "one place": np.zeros((150, 3)) + [0.1, 0.0, 0.0],
    }[cloud]
    o = dataclasses.replace(noisy_boxes[0], points=points + WORLD_M, observation=np.arange(150) % 2)
    row = jax.tree.map(jnp.asarray, batch.cut(as_row(o, LITTLE), 256))
    slope = np.asarray(slopes(tiny_prior, row))
    assert np.isfinite(slope).all() and not slope[150:].any()
    assert cloud == "one place" or (np.abs(slope[:150]).max(axis=1) > 0).mean() > 0.5
