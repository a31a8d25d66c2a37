"""Metrics of the paper (paper §4), in NumPy on the host; meters and degrees."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from more2_jax.geometry.poses import Matrix3, Points, Pose, apply_pose, rotation_error_deg

Errors = Sequence[float] | Float[np.ndarray, " n"]


def symmetry_aware_rotation_error_deg(
    R: Matrix3, R_true: Matrix3, axis: Float[np.ndarray, "3"], order: int
) -> float:
    """The smallest error over the object's symmetry group: turns about `axis` (in the source's frame).

    `order` 1: no symmetry; n: turns by 360°/n; 0: any turn, so that only the axis counts.
    """
    if order < 0:
        raise ValueError(f"symmetry order {order}; needed 0 (any turn), 1 (none) or more")
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    if order == 0:
        return float(np.rad2deg(np.arccos(np.clip((R @ axis) @ (R_true @ axis), -1, 1))))
    turns = [Rotation.from_rotvec(2 * np.pi * k / order * axis).as_matrix() for k in range(order)]
    return min(rotation_error_deg(R, R_true @ turn) for turn in turns)


def as_published_rotation_error_deg(R: Matrix3, R_true: Matrix3) -> float:
    """min(e, |180 − e|, |90 − e|), as the published FlyingShape evaluation counts it for every object."""
    error = rotation_error_deg(R, R_true)
    return min(error, abs(180 - error), abs(90 - error))


def translation_error(t: Float[np.ndarray, "3"], t_true: Float[np.ndarray, "3"]) -> float:
    """Distance between two translations, meters."""
    return float(np.linalg.norm(np.asarray(t) - t_true))


def recall(errors: Errors, threshold: float) -> float:
    """Share of errors below a threshold; a failure is infinite or NaN, and counts. NaN of nothing."""
    values = np.asarray(errors, float)
    return float(np.mean(values < threshold)) if len(values) else float("nan")


def instance_recall(
    predicted: Int[np.ndarray, " n"], truth: Int[np.ndarray, " n"], same: Int[np.ndarray, " m"]
) -> float:
    """Correct matches over true matches; −1 means no partner. NaN when nothing has a partner.

    `same[j]` is equal for targets that are identical copies: each may stand in for the other, but only
    once: a target that several sources claim is right for one of them.
    """
    has = truth >= 0
    right = has & (predicted >= 0) & (same[np.maximum(predicted, 0)] == same[np.maximum(truth, 0)])
    return float(len(np.unique(predicted[right])) / has.sum()) if has.any() else float("nan")


def scene_recall(recalls: Errors, share: float) -> float:
    """Share of scan pairs whose own instance recall is at least `share`."""
    return float(np.mean(np.asarray(recalls) >= share)) if len(recalls) else float("nan")


def transformation_rmse(T: Pose, T_true: Pose, source: Points, target: Points) -> float:
    """Root mean square distance between where two poses put points, over both directions, meters."""
    there = apply_pose(T, source) - apply_pose(T_true, source)
    back = apply_pose(np.linalg.inv(T), target) - apply_pose(np.linalg.inv(T_true), target)
    return float(np.sqrt(np.mean(np.sum(np.concatenate([there, back]) ** 2, axis=1))))


def as_published_rmse(T: Pose, T_true: Pose, source: Points, target: Points) -> float:
    """The same, a mean over coordinates too: √3 smaller, as the published code computes it."""
    return transformation_rmse(T, T_true, source, target) / np.sqrt(3)


def modified_chamfer(T: Pose, T_true: Pose, source: Points, target: Points) -> float:
    """Mean squared nearest distance of the moved source to the whole target and back, square meters.

    Whole: each cloud together with the other under the true pose, so that missing parts do not count.
    """
    whole_target = np.concatenate([target, apply_pose(T_true, source)])
    whole_source = np.concatenate([source, apply_pose(np.linalg.inv(T_true), target)])
    there = KDTree(whole_target).query(apply_pose(T, source))[0]
    back = KDTree(whole_source).query(apply_pose(np.linalg.inv(T), target))[0]
    return float(np.mean(there**2) + np.mean(back**2))


def accuracy(predicted: Points, truth: Points) -> float:
    """Mean distance of predicted surface points from the true surface, meters."""
    return float(KDTree(truth).query(predicted)[0].mean())


def completeness(predicted: Points, truth: Points) -> float:
    """Mean distance of true surface points from the predicted surface, meters."""
    return accuracy(truth, predicted)


def chamfer_l1(predicted: Points, truth: Points) -> float:
    """(accuracy + completeness) / 2, meters."""
    return (accuracy(predicted, truth) + completeness(predicted, truth)) / 2


def volume_iou(predicted: Bool[np.ndarray, " q"], truth: Bool[np.ndarray, " q"]) -> float:
    """Intersection over union of two solids, from inside tests at the same points; 0 when both are empty."""
    union = (predicted | truth).sum()
    return float((predicted & truth).sum() / union) if union else 0.0


def inside(mesh: trimesh.Trimesh, points: Points) -> Bool[np.ndarray, " n"]:
    """Inside tests against a closed mesh."""
    return np.asarray(mesh.contains(points), bool)


def sdf_recall(vertices_true: Points, mesh: trimesh.Trimesh, threshold: float = 0.05) -> float:
    """Share of true vertices closer to the predicted surface than `threshold` (in the vertices' unit).

    Needs the extra `data`.
    """
    import point_cloud_utils as pcu

    surface = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)
    distance = pcu.closest_points_on_mesh(np.asarray(vertices_true, np.float64, order="C"), *surface)[0]
    return float(np.mean(distance < threshold))


def f1(predicted: set[str], truth: set[str]) -> float:
    """Harmonic mean of precision and recall of a set; 1 when both are empty."""
    if not predicted and not truth:
        return 1.0
    return 2 * len(predicted & truth) / (len(predicted) + len(truth))


def ecdf(errors: Errors) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Sorted errors and the share at or below each."""
    values = np.sort(np.asarray(errors, float))
    return values, np.arange(1, len(values) + 1) / max(len(values), 1)


def bootstrap_ci95(values: Errors, seed: int = 0, draws: int = 2000) -> tuple[float, float]:
    """95 % interval of the mean by resampling; NaN of nothing."""
    data = np.asarray(values, float)
    if not len(data):
        return float("nan"), float("nan")
    index = np.random.default_rng(seed).integers(0, len(data), (draws, len(data)))
    low, high = np.quantile(data[index].mean(axis=1), [0.025, 0.975])
    return float(low), float(high)
