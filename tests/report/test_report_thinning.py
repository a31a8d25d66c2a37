"""Clouds and meshes of the page made smaller: even samples, closed surfaces, both sides of thin ones."""

import numpy as np
import pytest
import trimesh
from factories import cube

from more2_jax.report.thinning import cluster_vertices, coarse_faces, random_subsample
from more2_jax.types import Mesh


def test_thinning_keeps_an_even_sample():
    cloud = np.random.default_rng(0).uniform(size=(10_000, 3))
    few = random_subsample(cloud, 0.1)
    assert len(few) == 1000
    assert {tuple(p) for p in few} <= {tuple(p) for p in cloud}
    assert np.abs(few[:100].mean(axis=0) - 0.5).max() < 0.1  # the first part of it is a sample too


def test_simplified_mesh_is_near_the_whole():
    ball = trimesh.creation.icosphere(5)
    small = cluster_vertices(Mesh(vertices=ball.vertices, faces=ball.faces), 0.1)
    assert 0.01 * len(ball.faces) < len(small.faces) <= 0.1 * len(ball.faces)
    assert np.abs(np.linalg.norm(small.vertices, axis=1) - 1).max() < 0.05
    assert small.faces.max() == len(small.vertices) - 1
    assert cluster_vertices(cube(np.zeros(3)), 1.0).faces.shape == (12, 3)


def test_coarse_faces_are_few_closed_and_of_the_same_vertices():
    ball = trimesh.creation.icosphere(4)
    faces = coarse_faces(Mesh(vertices=ball.vertices, faces=ball.faces), 300)
    coarse = trimesh.Trimesh(ball.vertices, faces, process=False)
    assert 100 < len(faces) <= 300
    assert coarse.is_watertight
    assert 0.8 < coarse.volume / ball.volume < 1  # outside still is outside
    few = cube(np.zeros(3))
    assert coarse_faces(few, 12) is few.faces


def test_both_sides_of_a_thin_plate_stay():
    """In one cell of the grid across: its sides fall on each other and still are seen from both."""
    plate = trimesh.creation.box((1, 1, 0.001)).subdivide().subdivide().subdivide()
    coarse = trimesh.Trimesh(
        plate.vertices, coarse_faces(Mesh(vertices=plate.vertices, faces=plate.faces), 100)
    )
    up = coarse.face_normals[:, 2]
    for side in (1, -1):
        assert coarse.area_faces[side * up > 0.9].sum() == pytest.approx(1, abs=0.3)
