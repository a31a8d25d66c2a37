"""Scores of one pose (paper §4), in three columns.

`paper`: the printed formula. `published`: as the published code computes it. `strict`: over the object's own
symmetry group, in meters. A failure has None for every score.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from eval.data.truth import KnownObject
from more2_jax.geometry.poses import Points, Pose, apply_pose, rotation_error_deg
from more2_jax.metrics import as_published_rmse, modified_chamfer, transformation_rmse, translation_error
from train.furniture.symmetry import equivalent_poses

Scores = dict[str, float | None]

POINTS = 2048  # of each cloud, evenly taken, on which distances are measured
KEYS = (
    "re_deg.paper",
    "re_deg.published",
    "re_deg.strict",
    "te_m.paper",
    "te_m.strict",
    "rmse_m.paper",
    "rmse_m.published",
    "rmse_m.strict",
    "cd_m2.paper",
    "cd_m2.published",
    "cd_m.strict",
)


def failed_pose() -> Scores:
    """The scores of a pose that was not found."""
    return dict.fromkeys(KEYS)


def pose_scores(
    T: Pose | None,
    truth: KnownObject,
    other: KnownObject,
    scan: int,
    ref: int,
    source: Points,
    target: Points,
) -> Scores:
    """Scores of `T_ref_scan` for what `other` (the object itself, or its copy) looked like in `scan`.

    `source` and `target` are the raw clouds, each in its scan's frame.
    """
    if T is None or not np.isfinite(T).all():
        return failed_pose()
    T_true = truth.true_pose(other, scan, ref)
    source, target = evenly(source), evenly(target)
    poses = equivalent_poses(T, truth.T_scan_model[ref], other.T_scan_model[scan], truth.symmetry)
    middle = source.mean(axis=0, keepdims=True)
    scores: Scores = {
        "re_deg.paper": rotation_error_deg(T[:3, :3], T_true[:3, :3]),
        "re_deg.published": forgiven(rotation_error_deg(T[:3, :3], T_true[:3, :3]), truth.forgiven_deg),
        "re_deg.strict": min(rotation_error_deg(T[:3, :3], P[:3, :3]) for P in poses),
        "te_m.paper": translation_error(T[:3, 3], T_true[:3, 3]),
        "te_m.strict": min(
            translation_error(apply_pose(T, middle)[0], apply_pose(P, middle)[0]) for P in poses
        ),
        "rmse_m.paper": transformation_rmse(T, T_true, source, target),
        "rmse_m.published": as_published_rmse(T, T_true, source, target),
        "rmse_m.strict": min(transformation_rmse(T, P, source, target) for P in poses),
        "cd_m2.paper": modified_chamfer(T, T_true, source, target),
        "cd_m2.published": published_chamfer(T, T_true, source, target),
        "cd_m.strict": min(chamfer_distance(T, P, source, target) for P in poses[:4]),
    }
    return {k: float(v) for k, v in scores.items() if v is not None}


def evenly(points: Points, count: int = POINTS) -> Points:
    """At most `count` of the points, evenly by index."""
    return points[np.linspace(0, len(points) - 1, min(len(points), count)).astype(int)]


def forgiven(error_deg: float, angles_deg: tuple[float, ...]) -> float:
    """The least of an error and its distance to each of the angles, about whatever axis."""
    return min([error_deg, *(abs(a - error_deg) for a in angles_deg)])


def published_chamfer(T: Pose, T_true: Pose, source: Points, target: Points) -> float:
    """As the published code has it: moved source to raw target, and target to itself moved by T T_true⁻¹, squared."""
    there = KDTree(target).query(apply_pose(T, source))[0]
    back = KDTree(apply_pose(T @ np.linalg.inv(T_true), target)).query(target)[0]
    return float(np.mean(there**2) + np.mean(back**2))


def chamfer_distance(T: Pose, T_true: Pose, source: Points, target: Points) -> float:
    """The paper's modified chamfer as a distance: not squared, and the mean of both ways, meters."""
    whole_target = np.concatenate([target, apply_pose(T_true, source)])
    whole_source = np.concatenate([source, apply_pose(np.linalg.inv(T_true), target)])
    there = KDTree(whole_target).query(apply_pose(T, source))[0]
    back = KDTree(whole_source).query(apply_pose(np.linalg.inv(T), target))[0]
    return float((there.mean() + back.mean()) / 2)
