"""Parametric furniture: closed, in one piece, of a furniture's size, and a function of category and seed alone."""

import itertools
import time

import numpy as np
import point_cloud_utils as pcu
import pytest
import trimesh
from scipy.spatial import cKDTree

from train.furniture.procedural import CATEGORIES, furniture, procedural_mesh, procedural_recipes
from train.furniture.source_mesh import SourceMesh

SEEDS = 40
DISTINCT = 0.003  # m, mean distance of surfaces
BOUNDS = {  # lowest and highest of width x, depth y, height z (m)
    "bench": ((0.85, 1.9), (0.28, 0.75), (0.36, 1.1)),
    "bed": ((0.85, 2.6), (1.9, 2.4), (0.35, 1.5)),
    "pillow": ((0.12, 0.85), (0.06, 0.85), (0.06, 0.85)),
    "trash can": ((0.18, 0.45), (0.1, 0.55), (0.22, 1.1)),
    "stool": ((0.25, 0.65), (0.2, 0.65), (0.36, 1.1)),
    "sofa": ((1.25, 2.6), (0.7, 1.9), (0.6, 1.1)),
    "chair": ((0.35, 0.75), (0.36, 0.8), (0.7, 1.1)),
    "office chair": ((0.45, 0.85), (0.45, 0.95), (0.75, 1.6)),
    "armchair": ((0.55, 1.1), (0.55, 1.25), (0.55, 1.2)),
    "table": ((0.33, 2.3), (0.25, 1.7), (0.3, 1.15)),
    "desk": ((0.95, 1.9), (0.48, 1.8), (0.68, 1.45)),
    "cabinet": ((0.33, 2.1), (0.28, 0.75), (0.36, 2.3)),
    "shelf": ((0.43, 1.45), (0.2, 0.55), (0.65, 2.2)),
    "lamp": ((0.14, 1.5), (0.14, 0.75), (0.25, 2.3)),
}


@pytest.mark.parametrize("category", CATEGORIES)
def test_every_piece_is_one_closed_solid_on_the_floor(category: str):
    for seed in range(SEEDS):
        piece = procedural_mesh(category, seed)
        solid = trimesh.Trimesh(piece.vertices, piece.faces, process=False)
        assert solid.is_watertight, seed
        assert solid.is_winding_consistent, seed
        assert solid.volume > 0, seed
        assert solid.body_count == 1, seed
        low, high = solid.bounds
        assert low[2] == pytest.approx(0, abs=1e-9)
        np.testing.assert_allclose(low[:2], -high[:2], atol=1e-9)
        for extent, (least, most) in zip(high - low, BOUNDS[category], strict=True):
            assert least <= extent <= most, seed
        assert len(solid.faces) <= 15_000


def test_there_are_fourteen_kinds():
    assert set(BOUNDS) == set(CATEGORIES)
    assert len(CATEGORIES) == 14


@pytest.mark.parametrize("category", CATEGORIES)
def test_category_and_seed_decide_alone(category: str, monkeypatch: pytest.MonkeyPatch):
    one = procedural_mesh(category, 3)
    monkeypatch.setattr(
        furniture, "CATEGORIES", dict(reversed([*CATEGORIES.items(), ("boat", CATEGORIES["bed"])]))
    )
    again = procedural_mesh(category, 3)
    assert one.vertices.tobytes() == again.vertices.tobytes()
    assert one.faces.tobytes() == again.faces.tobytes()


def test_the_name_of_a_category_is_part_of_the_seed(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(furniture.CATEGORIES, "couch", CATEGORIES["sofa"])
    one, other = (procedural_mesh(category, 0).vertices for category in ("sofa", "couch"))
    assert one.shape != other.shape or not np.allclose(one, other)


def distance(points: np.ndarray, other: SourceMesh) -> float:
    """Mean distance (m) of points to the surface of a piece."""
    faces = other.faces.astype(np.int32)
    return float(pcu.closest_points_on_mesh(points, other.vertices, faces)[0].mean())


@pytest.mark.parametrize("category", CATEGORIES)
def test_no_two_seeds_make_nearly_the_same_piece(category: str):
    """The nearest pairs by their samples are far apart by the distance of samples to the other's surface."""
    pieces = [procedural_mesh(category, seed) for seed in range(SEEDS)]
    solids = [trimesh.Trimesh(p.vertices, p.faces, process=False) for p in pieces]
    clouds = [np.asarray(trimesh.sample.sample_surface(solid, 400, seed=0)[0]) for solid in solids]
    trees = [cKDTree(cloud) for cloud in clouds]
    pairs = list(itertools.combinations(range(SEEDS), 2))
    near = sorted(pairs, key=lambda pair: trees[pair[0]].query(clouds[pair[1]])[0].mean())[:12]
    for a, b in near:
        apart = max(distance(clouds[a], pieces[b]), distance(clouds[b], pieces[a]))
        assert apart > DISTINCT, (a, b)
    assert distance(clouds[0], pieces[0]) < 1e-6


def test_pieces_are_quick_to_make():
    start = time.process_time()
    count = len([recipe.mesh() for recipe in procedural_recipes(3 * len(CATEGORIES))])
    assert (time.process_time() - start) / count < 0.06


def test_categories_come_in_turn():
    pieces = [recipe.mesh() for recipe in procedural_recipes(len(CATEGORIES) + 1)]
    assert [p.category for p in pieces] == [*CATEGORIES, next(iter(CATEGORIES))]
    assert len({p.name for p in pieces}) == len(pieces)
    assert procedural_recipes(0) == []
    later = procedural_recipes(2, first=len(CATEGORIES) - 1)
    assert [p.name for p in later] == [p.name for p in pieces[-2:]]


def test_refusals():
    with pytest.raises(ValueError, match="'boat'; needed one of bench"):
        procedural_mesh("boat", 0)
    with pytest.raises(ValueError, match="seed -1; needed 0 or more"):
        procedural_mesh("bed", -1)
    with pytest.raises(ValueError, match="-1 procedural"):
        procedural_recipes(-1)
    with pytest.raises(ValueError, match="from number -2"):
        procedural_recipes(1, first=-2)
