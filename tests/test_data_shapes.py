"""Training shapes: distances against closed forms and winding numbers, views that lie on the surface."""

import numpy as np
import point_cloud_utils as pcu
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from shapes import box_distance, sphere

from more2_jax.data.depth_views import POINTS_A_VIEW, VIEWS, depth_views, view_directions
from more2_jax.data.procedural import procedural_mesh
from more2_jax.data.signed_distance import BOX, QUERIES, SHELL, canonical, measured_offset, signed_distances


def labelled(vertices: np.ndarray, faces: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    views = depth_views(vertices, faces, rng)
    return signed_distances(vertices, faces, views.reshape(-1, 3)[::10], rng)


# --- the canonical frame ------------------------------------------------------------------------------------


def test_canonical_is_centred_and_of_known_size():
    vertices, scale = canonical(np.array([[1.0, 2, 3], [5, 4, 3], [2, 3, 3.5]]))
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    np.testing.assert_allclose(low + high, 0, atol=1e-12)
    assert (high - low).max() == pytest.approx(0.9)
    assert scale == pytest.approx(4 / 0.9)


@pytest.mark.parametrize("bad", [np.zeros((0, 3)), np.ones((4, 3)), np.full((4, 3), np.nan)])
def test_canonical_refuses_what_has_no_size(bad: np.ndarray):
    with pytest.raises(ValueError, match="needed a shape"):
        canonical(bad)


# --- signed distances ---------------------------------------------------------------------------------------


def test_distances_of_a_sphere():
    for query in labelled(*sphere(0.45)):
        error = query[:, 3] - (np.linalg.norm(query[:, :3], axis=1) - 0.45)
        assert np.abs(error + SHELL).max() < 0.006  # the solid is a shell thicker, by design


def test_distances_of_a_flat_box_with_its_winding_turned_inside_out():
    half = np.array([0.45, 0.1, 0.02])
    box = trimesh.creation.box(2 * half)
    turn = Rotation.from_euler("xyz", [0.3, 0.5, 0.7]).as_matrix()
    for query in labelled(box.vertices @ turn.T, np.asarray(box.faces[:, ::-1])):
        error = query[:, 3] - box_distance(query[:, :3] @ turn, half)
        assert np.abs(error + SHELL).max() < 0.008


@pytest.mark.parametrize("category", ["bench", "cushion", "stool"])
def test_signs_agree_with_winding_numbers(category: str):
    piece = procedural_mesh(category, 0)
    vertices, _ = canonical(piece.vertices)
    query = np.concatenate(labelled(vertices, piece.faces))
    clear = query[np.abs(query[:, 3]) > 0.012]  # beyond the shell and the octree's cells
    faces = piece.faces.astype(np.int32)
    winding = pcu.triangle_soup_fast_winding_number(vertices, faces, clear[:, :3].copy())
    inside = clear[:, 3] < 0
    assert inside.sum() > 100
    assert np.mean(inside == (winding > 0.5)) > 0.998


def test_queries_fill_the_box_and_hug_the_surface():
    uniform, near = labelled(*sphere(0.45))
    assert uniform.shape == near.shape == (QUERIES, 4)
    np.testing.assert_allclose(uniform[:, :3].std(axis=0), BOX / np.sqrt(3), rtol=0.03)
    assert np.abs(uniform[:, :3]).max() <= BOX
    distance = np.abs(near[:, 3])
    assert np.median(distance[::2]) > 2.5 * np.median(distance[1::2])  # two widths of noise
    assert np.median(distance) < 0.03


def test_a_seed_decides_alone():
    piece = procedural_mesh("bench", 0)
    vertices, _ = canonical(piece.vertices)
    one, again, other = (labelled(vertices, piece.faces, seed)[1] for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)


def test_a_solid_that_is_not_the_shape_is_refused():
    assert measured_offset(np.full(10, -0.008)) == pytest.approx(0.008)
    with pytest.raises(ValueError, match=r"0\.0500 outside"):
        measured_offset(np.full(10, -0.05))
    with pytest.raises(ValueError, match="off the solid"):
        measured_offset(np.where(np.arange(10) < 7, -0.008, 0.2))


# --- depth views --------------------------------------------------------------------------------------------


def test_viewpoints_surround_the_shape():
    directions = view_directions()
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    np.testing.assert_allclose(directions.mean(axis=0), 0, atol=0.05)
    nearest = np.sort(directions @ directions.T, axis=1)[:, -2]
    assert np.rad2deg(np.arccos(nearest)).min() > 20  # an even spread of 24 leaves about 40°


def test_views_see_the_near_side_of_the_surface_and_no_other():
    views = depth_views(*sphere(0.45, subdivisions=5), np.random.default_rng(0))
    assert views.shape == (VIEWS, POINTS_A_VIEW, 3)
    np.testing.assert_allclose(np.linalg.norm(views, axis=-1), 0.45, atol=1e-3)
    height = np.einsum("vnc,vc->vn", views, view_directions())
    assert height.min() > 0.45**2 / 1.6 - 0.01  # the horizon seen from 1.6
    assert (height.max(axis=1) > 0.445).all()


def test_a_slender_shape_repeats_points_and_one_too_slender_is_refused():
    rod = trimesh.creation.box((0.02, 0.02, 0.9))
    views = depth_views(
        np.asarray(rod.vertices), np.asarray(rod.faces), np.random.default_rng(0), fewest_hits=1
    )
    distinct = [len(np.unique(view, axis=0)) for view in views]
    assert max(distinct) < POINTS_A_VIEW
    needle = trimesh.creation.box((1e-5, 1e-5, 0.9))
    with pytest.raises(ValueError, match="hits; needed 32"):
        depth_views(np.asarray(needle.vertices), np.asarray(needle.faces), np.random.default_rng(0))
