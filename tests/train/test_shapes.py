"""Training shapes: distances against closed forms and winding numbers, views that lie on the surface."""

import numpy as np
import point_cloud_utils as pcu
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from shapes import box_distance, sphere

from train.furniture.closed_solids import canonical, solidify
from train.furniture.procedural import procedural_mesh
from train.shards.depth_views import POINTS_A_VIEW, coverage, depth_views
from train.shards.shapes import fingerprint, make_shape
from train.shards.signed_distance import BOX, check_signs, is_inside, signed_distances
from train.shards.view_directions import VIEWS, view_directions

QUERIES = 8000


def labeled(vertices: np.ndarray, faces: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    uniform, near = signed_distances(vertices, faces, np.random.default_rng(seed), QUERIES)
    return uniform.astype(np.float64), near.astype(np.float64)


# --- the canonical frame ------------------------------------------------------------------------------------


def test_canonical_is_centered_and_of_known_size():
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
    for query in labeled(*sphere(0.45, subdivisions=5)):
        error = query[:, 3] - (np.linalg.norm(query[:, :3], axis=1) - 0.45)
        assert np.abs(error).max() < 0.001


def test_distances_of_a_flat_box_in_any_orientation():
    half = np.array([0.45, 0.1, 0.02])
    box = trimesh.creation.box(2 * half)
    turn = Rotation.from_euler("xyz", [0.3, 0.5, 0.7]).as_matrix()
    for query in labeled(box.vertices @ turn.T, np.asarray(box.faces)):
        error = query[:, 3] - box_distance(query[:, :3] @ turn, half)
        assert np.abs(error).max() < 4e-4  # half a step of float16


def test_distances_belong_to_the_rounded_positions():
    uniform, near = signed_distances(*sphere(0.45, subdivisions=5), np.random.default_rng(0), 500)
    assert uniform.dtype == near.dtype == np.float16
    query = near[:, :3].astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(query, axis=1) - 0.45, near[:, 3], atol=6e-4)


@pytest.mark.parametrize("category", ["bench", "stool", "bed"])
def test_signs_agree_with_winding_numbers(category: str):
    piece = procedural_mesh(category, 0)
    vertices, _ = canonical(piece.vertices)
    query = np.concatenate(labeled(vertices, piece.faces))
    winding = pcu.triangle_soup_fast_winding_number(
        vertices, piece.faces.astype(np.int32), np.ascontiguousarray(query[:, :3])
    )
    inside = query[:, 3] < 0
    assert inside.sum() > 100
    assert np.mean(inside == (winding > 0.5)) > 0.995


def test_signs_that_disagree_are_refused():
    vertices, faces = sphere(0.45)
    query = np.random.default_rng(0).uniform(-0.5, 0.5, (400, 3))
    inside = is_inside(vertices, faces, query)
    check_signs(vertices, faces, query, inside)
    with pytest.raises(ValueError, match="agree on 0"):
        check_signs(vertices, faces, query, inside ^ (np.arange(400) % 50 == 0))


def test_queries_fill_the_box_and_hug_the_surface():
    uniform, near = labeled(*sphere(0.45))
    assert uniform.shape == near.shape == (QUERIES, 4)
    np.testing.assert_allclose(uniform[:, :3].std(axis=0), BOX / np.sqrt(3), rtol=0.03)
    assert np.abs(uniform[:, :3]).max() <= BOX
    distance = np.abs(near[:, 3])
    assert np.median(distance[::2]) > 2.5 * np.median(distance[1::2])  # two widths of noise
    assert np.median(distance) < 0.03


def test_a_seed_decides_alone():
    piece = procedural_mesh("bench", 0)
    vertices, _ = canonical(piece.vertices)
    one, again, other = (labeled(vertices, piece.faces, seed)[1] for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)


def test_a_shape_depends_on_the_mesh_and_its_name_alone():
    piece = procedural_mesh("stool", 3)
    one, again = make_shape(piece, 200), make_shape(piece, 200)
    for name in ("vertices", "views", "sdf_uniform", "sdf_near", "fingerprint"):
        np.testing.assert_array_equal(getattr(one, name), getattr(again, name))
    assert one.meta == again.meta
    assert one.meta["split"] == piece.chosen_split
    assert one.meta["coverage"] > 0.9
    np.testing.assert_allclose(
        np.ptp(piece.vertices, axis=0).max() / one.meta["units_per_canonical"], 0.9, atol=2e-3
    )


def test_a_fingerprint_turns_with_the_shape():
    vertices, _ = canonical(procedural_mesh("sofa", 1).vertices)
    solid = solidify(vertices, procedural_mesh("sofa", 1).faces)
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = fingerprint(np.ascontiguousarray(solid.vertices @ quarter.T), solid.faces)
    expected = np.rot90(fingerprint(solid.vertices, solid.faces), 1, axes=(0, 1))
    np.testing.assert_allclose(turned.astype(float), expected.astype(float), atol=1e-3)


# --- depth views --------------------------------------------------------------------------------------------


def test_viewpoints_surround_the_shape():
    directions = view_directions()
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    np.testing.assert_allclose(directions.mean(axis=0), 0, atol=0.05)
    nearest = np.sort(directions @ directions.T, axis=1)[:, -2]
    assert np.rad2deg(np.arccos(nearest)).min() > 20  # an even spread of 24 leaves about 40°


def test_views_see_the_near_side_of_the_surface_and_no_other():
    views, normals = depth_views(*sphere(0.45, subdivisions=5), np.random.default_rng(0))
    assert views.shape == normals.shape == (VIEWS, POINTS_A_VIEW, 3)
    np.testing.assert_allclose(np.linalg.norm(views, axis=-1), 0.45, atol=1e-3)
    height = np.einsum("vnc,vc->vn", views, view_directions())
    assert height.min() > 0.45**2 / 1.6 - 0.01  # the horizon seen from 1.6
    assert (height.max(axis=1) > 0.445).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1)
    assert np.einsum("vnc,vnc->vn", views, normals).min() > 0.45 * 0.999  # outward, along the radius


def test_coverage_is_the_share_of_the_visible_surface_that_was_seen():
    assert coverage(*sphere(0.45, subdivisions=5), np.random.default_rng(0)) == 1.0
    # A deep narrow well: its bottom is seen along the axis only, which none of the 24 directions is.
    tube = trimesh.creation.annulus(r_min=0.03, r_max=0.2, height=0.9)
    tube.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], view_directions(300)[40]))
    deep = coverage(np.asarray(tube.vertices), np.asarray(tube.faces), np.random.default_rng(0))
    assert 0.5 < deep < 0.97


def test_a_slender_shape_repeats_points_and_one_too_slender_is_refused():
    rod = trimesh.creation.box((0.02, 0.02, 0.9))
    views, _ = depth_views(
        np.asarray(rod.vertices), np.asarray(rod.faces), np.random.default_rng(0), fewest_hits=1
    )
    distinct = [len(np.unique(view, axis=0)) for view in views]
    assert max(distinct) < POINTS_A_VIEW
    needle = trimesh.creation.box((1e-5, 1e-5, 0.9))
    with pytest.raises(ValueError, match="hits; needed 32"):
        depth_views(np.asarray(needle.vertices), np.asarray(needle.faces), np.random.default_rng(0))
