"""Parametric furniture: closed, in one piece, furniture-sized, and a function of its seed."""

import numpy as np
import pytest
import trimesh

from more2_jax.data.procedural import CATEGORIES, procedural_mesh, procedural_meshes


@pytest.mark.parametrize("category", CATEGORIES)
@pytest.mark.parametrize("seed", range(6))
def test_every_piece_is_one_closed_solid_on_the_floor(category: str, seed: int):
    piece = procedural_mesh(category, seed)
    solid = trimesh.Trimesh(piece.vertices, piece.faces, process=False)
    assert solid.is_watertight
    assert solid.volume > 0
    assert solid.body_count == 1
    assert solid.bounds[0, 2] == pytest.approx(0, abs=1e-9)
    assert 0.2 < solid.extents.max() < 2.6


@pytest.mark.parametrize("category", CATEGORIES)
def test_seeds_decide_alone(category: str):
    one, again, other = (procedural_mesh(category, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.vertices, again.vertices)
    np.testing.assert_array_equal(one.faces, again.faces)
    assert not np.allclose(np.ptp(one.vertices, axis=0), np.ptp(other.vertices, axis=0))


def test_categories_come_in_turn():
    pieces = list(procedural_meshes(len(CATEGORIES) + 1))
    assert [p.category for p in pieces] == [*CATEGORIES, next(iter(CATEGORIES))]
    assert len({p.name for p in pieces}) == len(pieces)
    assert list(procedural_meshes(0)) == []


def test_refusals():
    with pytest.raises(ValueError, match="'boat'; needed one of bench"):
        procedural_mesh("boat", 0)
    with pytest.raises(ValueError, match="-1 procedural"):
        list(procedural_meshes(-1))
