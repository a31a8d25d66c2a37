"""Distances between two poses of one object, measured on its points (paper §4): meters, square meters where it says so.

`T` and `T_true` are poses of the source in the target's frame; `source` and `target` the clouds, each in its own.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from more2_jax.geometry.poses import Points, Pose, apply_pose


def transformation_rmse(T: Pose, T_true: Pose, source: Points, target: Points) -> float:
    """Root mean square distance between where two poses put points, over both directions, meters."""
    there = apply_pose(T, source) - apply_pose(T_true, source)
    back = apply_pose(np.linalg.inv(T), target) - apply_pose(np.linalg.inv(T_true), target)
    return float(np.sqrt(np.mean(np.sum(np.concatenate([there, back]) ** 2, axis=1))))


def as_published_rmse(T: Pose, T_true: Pose, source: Points, target: Points) -> float:
    """The same, a mean over coordinates too: √3 smaller, as the published code computes it."""
    return transformation_rmse(T, T_true, source, target) / np.sqrt(3)


def modified_chamfer(T: Pose, T_true: Pose, source: Points, target: Points) -> float:
    """Mean squared nearest distance of the moved source to the whole target and back, square meters."""
    there, back = nearest_of_whole_clouds(T, T_true, source, target)
    return float(np.mean(there**2) + np.mean(back**2))


def modified_chamfer_distance(T: Pose, T_true: Pose, source: Points, target: Points) -> float:
    """The modified Chamfer as a distance: not squared, and the mean of both ways, meters."""
    there, back = nearest_of_whole_clouds(T, T_true, source, target)
    return float((there.mean() + back.mean()) / 2)


def as_published_chamfer(T: Pose, T_true: Pose, source: Points, target: Points) -> float:
    """As published code has it: moved source to raw target, and target to itself moved by T T_true⁻¹, square meters."""
    there = KDTree(target).query(apply_pose(T, source))[0]
    back = KDTree(apply_pose(T @ np.linalg.inv(T_true), target)).query(target)[0]
    return float(np.mean(there**2) + np.mean(back**2))


def nearest_of_whole_clouds(
    T: Pose, T_true: Pose, source: Points, target: Points
) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, " t"]]:
    """Distances of the moved source from the whole target, and of the target moved back from the whole source.

    Whole: each cloud together with the other under the true pose, so that missing parts do not count. Meters.
    """
    whole_target = np.concatenate([target, apply_pose(T_true, source)])
    whole_source = np.concatenate([source, apply_pose(np.linalg.inv(T_true), target)])
    there = KDTree(whole_target).query(apply_pose(T, source))[0]
    back = KDTree(whole_source).query(apply_pose(np.linalg.inv(T), target))[0]
    return np.asarray(there), np.asarray(back)
