"""Metrics (paper §4) against slow, independent computations; each has a case that gives zero and one that does not."""

import itertools
import math

import numpy as np
import pytest
import trimesh
from scipy.linalg import logm
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from more2_jax import metrics

RNG = np.random.default_rng(0)
CLOUD = RNG.normal(size=(60, 3))
OTHER = RNG.normal(size=(45, 3))


def turn(axis, degrees):
    return Rotation.from_rotvec(np.deg2rad(degrees) * np.asarray(axis, float)).as_matrix()


def pose(rotation, translation):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation
    return T


T_TRUE = pose(turn([0, 0, 1], 40), [0.5, -1, 2])
T_NEAR = pose(turn([0, 0.6, 0.8], 43), [0.52, -1.1, 2])


# --- rotations ------------------------------------------------------------------------------------------------


def test_rotation_error_is_the_length_of_the_matrix_logarithm():
    for a, b in itertools.pairwise(Rotation.random(20, random_state=1).as_matrix()):
        expected = np.rad2deg(np.linalg.norm(logm(a.T @ b)) / math.sqrt(2))
        assert metrics.rotation_error_deg(a, b) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("degrees", [0.0, 1e-7, 1e-3, 1.0, 90.0, 179.9999, 180.0])
def test_rotation_error_is_exact_at_both_ends(degrees):
    # arccos of the trace loses half of all digits near 0 and near 180°.
    assert metrics.rotation_error_deg(turn([0, 1, 0], degrees), np.eye(3)) == pytest.approx(degrees, abs=1e-9)


@pytest.mark.parametrize(("order", "expected"), [(1, 170), (2, 10), (3, 50), (4, 10), (0, 0)])
def test_symmetric_error_is_the_least_over_the_group(order, expected):
    error = metrics.symmetry_aware_rotation_error_deg(
        turn([0, 0, 1], 170), np.eye(3), np.array([0, 0, 3.0]), order
    )
    assert error == pytest.approx(expected, abs=1e-6)


def test_any_turn_is_the_limit_of_a_high_order():
    axis = np.array([0.6, 0, 0.8])
    for R, R_true in itertools.pairwise(Rotation.random(8, random_state=2).as_matrix()):
        least = metrics.symmetry_aware_rotation_error_deg(R, R_true, axis, 0)
        assert least == pytest.approx(
            metrics.symmetry_aware_rotation_error_deg(R, R_true, axis, 1440), abs=0.2
        )


def test_symmetry_acts_in_the_frame_of_the_source():
    R_true = turn([1, 0, 0], 90)
    symmetric = R_true @ turn([0, 0, 1], 180)
    assert metrics.symmetry_aware_rotation_error_deg(symmetric, R_true, np.array([0, 0, 1.0]), 2) < 1e-6
    tipped = turn([0, 0, 1], 180) @ R_true
    assert metrics.symmetry_aware_rotation_error_deg(tipped, R_true, np.array([0, 0, 1.0]), 2) > 90


def test_tipping_over_is_an_error_whatever_the_symmetry():
    for order in (0, 1, 2, 7):
        error = metrics.symmetry_aware_rotation_error_deg(
            turn([1, 0, 0], 90), np.eye(3), np.array([0, 0, 1.0]), order
        )
        assert error == pytest.approx(90, abs=1e-6)


def test_negative_symmetry_order_is_refused():
    with pytest.raises(ValueError, match="symmetry order -1"):
        metrics.symmetry_aware_rotation_error_deg(np.eye(3), np.eye(3), np.array([0, 0, 1.0]), -1)


@pytest.mark.parametrize(
    ("degrees", "expected"), [(0, 0), (3, 3), (93, 3), (86, 4), (177, 3), (45, 45), (135, 45)]
)
def test_as_published_error_forgives_quarter_and_half_turns(degrees, expected):
    error = metrics.as_published_rotation_error_deg(turn([0, 1, 0], degrees), np.eye(3))
    assert error == pytest.approx(expected, abs=1e-9)


def test_translation_error():
    assert metrics.translation_error(np.array([1.0, 2, 3]), np.array([1.0, 2, 3])) == 0
    assert metrics.translation_error(np.array([1000.0, 0, 0]), np.array([1000.0, 3, 4])) == 5


# --- recalls --------------------------------------------------------------------------------------------------


def test_recall_counts_failures():
    assert metrics.recall([1.0, 4.9, 5.0, float("inf"), float("nan")], 5.0) == pytest.approx(2 / 5)
    assert metrics.recall([0.0], 5.0) == 1
    assert metrics.recall([5.0], 5.0) == 0
    assert math.isnan(metrics.recall([], 5.0))


@pytest.mark.parametrize(
    ("predicted", "expected"),
    [
        ([0, 1, 2, -1], 1),
        ([0, 2, 1, -1], 1),  # targets 1 and 2 are copies: changed about, they are as good
        ([1, 0, -1, 3], 0),
        ([0, -1, 3, -1], 1 / 3),
        ([0, 1, 2, 3], 1),  # a partner for an object that has none is not this metric's business
    ],
)
def test_instance_recall(predicted, expected):
    truth, same = np.array([0, 1, 2, -1]), np.array([0, 1, 1, 2])
    assert metrics.instance_recall(np.array(predicted), truth, same) == pytest.approx(expected)


def test_a_copy_counts_for_one_object_only():
    # Both sources claim target 1; its copy, target 2, goes unclaimed. At most one of the two can be right.
    truth, same = np.array([1, 2]), np.array([0, 1, 1])
    assert metrics.instance_recall(np.array([1, 1]), truth, same) == 0.5


def test_instance_recall_of_no_true_match():
    same = np.array([0])
    assert math.isnan(metrics.instance_recall(np.array([0, -1]), np.array([-1, -1]), same))


def test_scene_recall_is_reached_at_the_share_itself():
    recalls = [0.25, 0.5, 1.0, 0.0, float("nan")]
    assert [metrics.scene_recall(recalls, s) for s in (0.25, 0.5, 0.75, 1.0)] == [0.6, 0.4, 0.2, 0.2]
    assert math.isnan(metrics.scene_recall([], 0.5))


def test_f1():
    assert metrics.f1({"a", "b"}, {"a", "b"}) == 1
    assert metrics.f1({"a"}, {"b"}) == 0
    assert metrics.f1(set(), set()) == 1
    assert metrics.f1(set(), {"a"}) == 0
    precision, recall = 1 / 3, 1 / 2
    expected = 2 * precision * recall / (precision + recall)
    assert metrics.f1({"a", "x", "y"}, {"a", "b"}) == pytest.approx(expected)


# --- poses on points ------------------------------------------------------------------------------------------


def moved(T, points):
    return np.array([(T @ [*p, 1.0])[:3] for p in points])


def test_apply_pose_is_the_homogeneous_product():
    np.testing.assert_allclose(metrics.apply_pose(T_TRUE, CLOUD), moved(T_TRUE, CLOUD), atol=1e-12)


def test_rmse_is_the_root_of_the_mean_square_over_both_directions():
    square = [sum((a - b) ** 2) for a, b in zip(moved(T_NEAR, CLOUD), moved(T_TRUE, CLOUD), strict=True)]
    back = moved(np.linalg.inv(T_NEAR), OTHER), moved(np.linalg.inv(T_TRUE), OTHER)
    square += [sum((a - b) ** 2) for a, b in zip(*back, strict=True)]
    expected = math.sqrt(sum(square) / len(square))
    assert metrics.transformation_rmse(T_NEAR, T_TRUE, CLOUD, OTHER) == pytest.approx(expected)
    assert metrics.transformation_rmse(T_TRUE, T_TRUE, CLOUD, OTHER) == 0


def test_a_pure_shift_is_its_own_rmse_and_the_published_one_is_a_root_of_three_less():
    shifted = pose(np.eye(3), [1, 1, 1])
    assert metrics.transformation_rmse(shifted, np.eye(4), CLOUD, OTHER) == pytest.approx(math.sqrt(3))
    assert metrics.as_published_rmse(shifted, np.eye(4), CLOUD, OTHER) == pytest.approx(1)


def test_modified_chamfer_against_all_distances():
    whole_target = np.concatenate([OTHER, moved(T_TRUE, CLOUD)])
    whole_source = np.concatenate([CLOUD, moved(np.linalg.inv(T_TRUE), OTHER)])
    there = cdist(moved(T_NEAR, CLOUD), whole_target, "sqeuclidean").min(axis=1).mean()
    back = cdist(moved(np.linalg.inv(T_NEAR), OTHER), whole_source, "sqeuclidean").min(axis=1).mean()
    assert metrics.modified_chamfer(T_NEAR, T_TRUE, CLOUD, OTHER) == pytest.approx(there + back)


def test_modified_chamfer_of_the_true_pose_is_zero_though_the_clouds_overlap_nowhere():
    assert metrics.modified_chamfer(T_TRUE, T_TRUE, CLOUD, OTHER + 100) == pytest.approx(0, abs=1e-20)


# --- surfaces and solids --------------------------------------------------------------------------------------


def test_chamfer_against_all_distances():
    distances = cdist(CLOUD, OTHER)
    accuracy, completeness = distances.min(axis=1).mean(), distances.min(axis=0).mean()
    assert metrics.accuracy(CLOUD, OTHER) == pytest.approx(accuracy)
    assert metrics.completeness(CLOUD, OTHER) == pytest.approx(completeness)
    assert metrics.chamfer_l1(CLOUD, OTHER) == pytest.approx((accuracy + completeness) / 2)
    assert metrics.chamfer_l1(CLOUD, CLOUD[::-1]) == 0


def test_a_part_is_accurate_but_not_complete():
    assert metrics.accuracy(CLOUD[:10], CLOUD) == 0
    assert metrics.completeness(CLOUD[:10], CLOUD) > 0.1


def test_volume_iou():
    a, b, none = np.array([1, 1, 1, 0], bool), np.array([0, 1, 1, 1], bool), np.zeros(4, bool)
    assert metrics.volume_iou(a, b) == 0.5
    assert metrics.volume_iou(a, a) == 1
    assert metrics.volume_iou(a, ~a) == 0
    assert metrics.volume_iou(none, none) == 0


def test_iou_of_shifted_boxes_by_inside_tests():
    box = trimesh.creation.box((1, 1, 1))
    half = trimesh.creation.box((1, 1, 1), transform=pose(np.eye(3), [0.5, 0, 0]))
    points = np.random.default_rng(3).uniform([-0.5, -0.5, -0.5], [1, 0.5, 0.5], size=(4000, 3))
    inside = metrics.inside(box, points)
    np.testing.assert_array_equal(inside, np.abs(points).max(axis=1) < 0.5)
    assert metrics.volume_iou(inside, metrics.inside(half, points)) == pytest.approx(1 / 3, abs=0.03)


def test_sdf_recall_of_a_plane_at_known_heights():
    plane = trimesh.Trimesh([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], [[0, 1, 2], [0, 2, 3]])
    heights = np.array([[0, 0, 0.0], [1, 1, 0.04], [2, 0, -0.04], [0, 2, 0.06], [1, 0, -0.2]])
    assert metrics.sdf_recall(heights, plane) == pytest.approx(3 / 5)
    assert metrics.sdf_recall(heights, plane, threshold=1.0) == 1
    assert metrics.sdf_recall(heights + [0, 0, 5], plane) == 0


# --- distributions --------------------------------------------------------------------------------------------


def test_ecdf_counts_errors_at_or_below():
    errors = [3.0, 1.0, 2.0, 2.0]
    values, share = metrics.ecdf(errors)
    assert values.tolist() == [1, 2, 2, 3]
    assert share.tolist() == [0.25, 0.5, 0.75, 1]
    assert len(metrics.ecdf([])[0]) == 0


def test_bootstrap_interval_agrees_with_the_normal_one():
    values = np.random.default_rng(4).normal(5, 2, size=400)
    low, high = metrics.bootstrap_ci95(values)
    error = 1.96 * values.std() / math.sqrt(400)
    assert low == pytest.approx(values.mean() - error, abs=0.05)
    assert high == pytest.approx(values.mean() + error, abs=0.05)


def test_bootstrap_of_constants_of_nothing_and_twice():
    assert metrics.bootstrap_ci95([2.0, 2.0]) == (2, 2)
    assert all(map(math.isnan, metrics.bootstrap_ci95([])))
    assert metrics.bootstrap_ci95([1.0, 2.0, 5.0]) == metrics.bootstrap_ci95([1.0, 2.0, 5.0])
