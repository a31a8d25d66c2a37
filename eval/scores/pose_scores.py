"""Scores of one pose (paper §4), in three columns.

`paper`: the printed formula. `published`: as the published code computes it. `strict`: over the object's own
symmetry group, in meters. A failure has None for every score.
"""

from __future__ import annotations

import numpy as np

from eval.data.truth import KnownObject
from eval.scores.pose_distances import (
    as_published_chamfer,
    as_published_rmse,
    modified_chamfer,
    modified_chamfer_distance,
    transformation_rmse,
)
from more2_jax.geometry.poses import Points, Pose, apply_pose, rotation_error_deg
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
        "te_m.paper": float(np.linalg.norm(T[:3, 3] - T_true[:3, 3])),
        "te_m.strict": min(
            float(np.linalg.norm(apply_pose(T, middle) - apply_pose(P, middle))) for P in poses
        ),
        "rmse_m.paper": transformation_rmse(T, T_true, source, target),
        "rmse_m.published": as_published_rmse(T, T_true, source, target),
        "rmse_m.strict": min(transformation_rmse(T, P, source, target) for P in poses),
        "cd_m2.paper": modified_chamfer(T, T_true, source, target),
        "cd_m2.published": as_published_chamfer(T, T_true, source, target),
        "cd_m.strict": min(modified_chamfer_distance(T, P, source, target) for P in poses[:4]),
    }
    return {k: float(v) for k, v in scores.items() if v is not None}


def evenly(points: Points, count: int = POINTS) -> Points:
    """At most `count` of the points, evenly by index."""
    return points[np.linspace(0, len(points) - 1, min(len(points), count)).astype(int)]


def forgiven(error_deg: float, angles_deg: tuple[float, ...]) -> float:
    """The least of an error and its distance to each of the angles, about whatever axis."""
    return min([error_deg, *(abs(a - error_deg) for a in angles_deg)])
