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


CONFIG = with_meshing(coarse_resolution=8, field_resolution=16, resolution=32)


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
def hard(tiny_prior):
    """Objects that are unlike one another, and unlike a good scan."""
    up = np.tile([0.0, 0.0, 1.0], (600, 1))
    plane = np.random.default_rng(3).uniform(-0.5, 0.5, (600, 3)) * [1, 1, 0]
    floor = np.random.default_rng(4).uniform(-3, 3, (4000, 3)) * [1, 1, 0] - [0, 0, 0.2] + WORLD_M
    eyes = (np.array([[3.0, 0, 1], [0, -3, 1]]) + WORLD_M, np.array([[-3.0, 1, 1]]) + WORLD_M)
    make = functools.partial(accumulated, tiny_prior)
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
    }


def solid(mesh, place):
    return trimesh.Trimesh(mesh.vertices - place, mesh.faces, process=False)


def apart_cm(a, b):
    """Mean distance of a's points from b's triangles, by the nearest of many samples and its plane; and the worst 1 %."""
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


NAMES = [
    "box",
    "noisy",
    "sensors",
    "plane with normals",
    "five points",
    "fifteen points",
    "doubled",
    "one place",
    "floor",
    "large",
]


@pytest.fixture(scope="module")
def made(tiny_prior, hard):
    return dict(zip(hard, device_meshes(tiny_prior, hard.values(), CONFIG), strict=True))


@pytest.mark.parametrize("name", NAMES)
def test_meshes_are_the_hosts(tiny_prior, hard, made, name):
    expected, found = object_mesh(tiny_prior, hard[name], CONFIG), made[name]
    assert (found is None) == (expected is None)
    if expected is not None:
        assert_same(expected, found, WORLD_M, 0.3, 0.03)
