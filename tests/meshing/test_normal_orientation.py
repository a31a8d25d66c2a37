"""Which side is outside: bodies whose normals are known, fields that are right, wrong or silent."""

import numpy as np
import pytest
import trimesh
from scipy.sparse.linalg import spsolve
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from more2_jax.meshing.normal_orientation import (
    MAX_DISTANCE,
    MAX_VOTERS,
    conjugate_gradients,
    free_distance,
    nearest_neighbors,
    outward_signs,
    sensor_votes,
    signed_graph,
)

GAP = 0.05


def surface_of(mesh, count=3000):
    points, face = trimesh.sample.sample_surface(mesh, count, seed=0)
    return np.asarray(points), mesh.face_normals[face]


def flipped(normals, seed=0):
    """Normals without a side, and which of them go outward."""
    sign = np.random.default_rng(seed).choice([-1.0, 1.0], len(normals))
    return sign[:, None] * normals, sign


def shelf():
    """Three boards of 0.03 and two sides, 0.25 between the boards."""
    boards = [
        trimesh.creation.box([0.7, 0.3, 0.03], trimesh.transformations.translation_matrix([0, 0, z]))
        for z in (-0.28, 0.0, 0.28)
    ]
    return trimesh.util.concatenate(boards)


@pytest.mark.parametrize(
    "mesh", [trimesh.creation.icosphere(radius=0.3), trimesh.creation.box([0.6, 0.3, 0.1]), shelf()]
)
@pytest.mark.parametrize("field", [1.0, 0.0])
def test_whole_bodies_are_oriented_with_or_without_the_field(mesh, field):
    points, true = surface_of(mesh)
    normals, sign = flipped(true)
    found = outward_signs(KDTree(points), normals, field * sign, GAP, -np.inf)
    assert (found == sign).mean() > 0.97


def test_a_shelf_that_the_field_fills_is_oriented_all_the_same():
    """For the field the inner faces of the boards rise the wrong way."""
    points, true = surface_of(shelf())
    inner = np.abs(points[:, 2]) < 0.27
    normals, sign = flipped(true)
    found = outward_signs(KDTree(points), normals, np.where(inner, -sign, sign), GAP, -np.inf)
    assert (found == sign).mean() > 0.95


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_of_a_single_sheet_the_field_decides(side):
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (1500, 2)), np.zeros(1500)])
    normals, sign = flipped(np.tile([0.0, 0.0, 1.0], (1500, 1)))
    assert (outward_signs(KDTree(points), normals, side * sign, GAP, -np.inf) == side * sign).all()


@pytest.mark.parametrize("field", [0.0, -1.0])
def test_a_sheet_faces_where_the_scan_says_though_some_normals_are_missing_or_wrong(field):
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (1500, 2)), np.zeros(1500)])
    up = np.tile([0.0, 0.0, 1.0], (1500, 1))
    normals, sign = flipped(up)
    given = up * rng.choice([0.0, 1.0, -1.0], (1500, 1), p=[0.4, 0.5, 0.1])
    args = KDTree(points), normals, field * sign, GAP, -np.inf
    assert (outward_signs(*args, given=given) == sign).all()
    assert (outward_signs(*args, given=-given) == -sign).all()
    nothing = outward_signs(*args, given=np.zeros_like(up))
    np.testing.assert_array_equal(nothing, outward_signs(*args))


def test_below_the_floor_there_is_no_free_space():
    """A sheet just above the floor: what lies between them is the thing."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (1500, 2)), np.zeros(1500)])
    normals, sign = flipped(np.tile([0.0, 0.0, 1.0], (1500, 1)))
    assert (outward_signs(KDTree(points), normals, 0.0 * sign, GAP, -0.2) == sign).all()


def test_turning_everything_changes_nothing():
    points, true = surface_of(trimesh.creation.box([0.6, 0.3, 0.1]), 800)
    normals, sign = flipped(true)
    R = Rotation.random(random_state=1).as_matrix()
    here = outward_signs(KDTree(points), normals, sign, GAP, -np.inf)
    turned = outward_signs(KDTree(points @ R.T), normals @ R.T, sign, GAP, -np.inf)
    assert (here == turned).mean() > 0.999


def test_the_first_point_met_is_told_to_a_third():
    points = np.array([[0.0, 0, 0], [0.0, 0, 0.4]])
    tree = KDTree(points)
    up = free_distance(tree, points, np.tile([0.0, 0, 1], (2, 1)), GAP, -np.inf)
    assert 0.27 < up[0] < 0.53 and up[1] == 1.0
    down = free_distance(tree, points, np.tile([0.0, 0, -1], (2, 1)), GAP, -np.inf)
    assert down[0] == 1.0 and 0.27 < down[1] < 0.53
    assert MAX_DISTANCE < 1.0


def test_points_on_one_spot_are_no_error():
    found = outward_signs(KDTree(np.zeros((30, 3))), np.tile([0.0, 0, 1], (30, 1)), np.ones(30), GAP, -np.inf)
    assert set(found) <= {-1.0, 1.0}


def test_the_votes_are_the_linear_system_s_solution():
    points, true = surface_of(shelf(), 2000)
    normals, sign = flipped(true)
    vote = sign + 2 * np.random.default_rng(0).normal(size=len(sign))
    matrix, right = signed_graph(points, normals, vote, nearest_neighbors(KDTree(points)))
    np.testing.assert_allclose((matrix - matrix.T).toarray(), 0, atol=1e-12)
    exact = spsolve(matrix.tocsc(), right)
    found = conjugate_gradients(matrix, right, vote)
    assert np.linalg.norm(matrix @ found - right) <= 1e-3 * np.linalg.norm(right)
    assert ((found < 0) == (exact < 0))[np.abs(exact) > 0.01 * np.abs(exact).max()].all()
    np.testing.assert_array_equal(conjugate_gradients(matrix, right, exact), exact)  # nothing is left to do


def from_places(points, *places):
    return np.broadcast_to(np.array(places, float), (len(points), len(places), 3))


def sheet(z=0.0, count=1500):
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (count, 2)), np.full(count, z)])
    return points, np.tile([0.0, 0.0, 1.0], (count, 1))


def test_a_surface_faces_its_only_sensor():
    points, up = sheet()
    normals, sign = flipped(up)
    for height in (2.0, -2.0):
        seen = sensor_votes(KDTree(points), points, normals, from_places(points, [0.3, 0.1, height]), GAP)
        np.testing.assert_array_equal(seen, np.sign(height) * sign)


def test_what_is_hidden_from_a_sensor_was_seen_by_another():
    """Two sheets, 0.2 apart, and a sensor on either side: each sheet hides the other from one of them."""
    (above, up), (below, _) = sheet(0.1), sheet(-0.1)
    points = np.concatenate([above, below])
    places = from_places(points, [0.0, 0, 2.0], [0.0, 0, -2.0])
    seen = sensor_votes(KDTree(points), points, np.concatenate([up, up]), places, GAP)
    inner = np.abs(points[:, :2]).max(axis=1) < 0.3
    assert (seen[: len(above)][inner[: len(above)]] == 1).all()
    assert (seen[len(above) :][inner[len(above) :]] == -1).all()


def test_sensors_that_nothing_hides_on_both_sides_say_nothing():
    points, up = sheet()
    seen = sensor_votes(KDTree(points), points, up, from_places(points, [0.0, 0, 2.0], [0.0, 0, -2.0]), GAP)
    np.testing.assert_allclose(seen, 0.0, atol=1e-12)


def test_unknown_places_and_a_sensor_at_the_point_say_nothing():
    points, up = sheet()
    nowhere = np.full((len(points), 2, 3), np.nan)
    assert not sensor_votes(KDTree(points), points, up, nowhere, GAP).any()
    assert not sensor_votes(KDTree(points), points, up, points[:, None], GAP).any()
    filled = nowhere.copy()
    filled[:, 1] = [0.0, 0, 2.0]
    assert (sensor_votes(KDTree(points), points, up, filled, GAP) == 1).all()


def test_of_many_points_some_look_around_and_the_rest_hears_them():
    points, true = surface_of(shelf(), 3 * MAX_VOTERS)
    normals, sign = flipped(true)
    assert (outward_signs(KDTree(points), normals, 0.0 * sign, GAP, -np.inf) == sign).mean() > 0.95


def test_a_sensor_outweighs_field_and_surroundings():
    """The inner faces of a box without a lid, seen from above: for the field, and for what lies behind, solid."""
    box = trimesh.creation.box([0.5, 0.5, 0.5])
    points, true = surface_of(box)
    inside = points[points[:, 2] < 0.249]
    normals, sign = flipped(-true[points[:, 2] < 0.249])
    places = from_places(inside, [0.0, 0.0, 0.8])
    args = (KDTree(inside), normals, -sign, GAP, -np.inf)
    assert (outward_signs(*args, places) == sign).mean() > 0.97
    assert (outward_signs(*args) == sign).mean() < 0.5
