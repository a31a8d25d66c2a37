"""How far poses and surfaces are from the true ones (paper §4), in NumPy on the host; meters and degrees.

What the demo is scored by. Scores of whole benchmarks, with the published variants, are in `eval/scores/`.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from more2_jax.geometry.poses import Matrix3, Points, rotation_error_deg


def symmetry_aware_rotation_error_deg(
    R: Matrix3, R_true: Matrix3, axis: Float[np.ndarray, "3"], order: int
) -> float:
    """The smallest error over the object's symmetry group: turns about `axis` (in the source's frame).

    `order` 1: no symmetry; n: turns by 360°/n; 0: any turn, so that only the axis counts. Raises ValueError below 0.
    """
    if order < 0:
        raise ValueError(f"symmetry order {order}; needed 0 (any turn), 1 (none) or more")
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    if order == 0:
        return float(np.rad2deg(np.arccos(np.clip((R @ axis) @ (R_true @ axis), -1, 1))))
    turns = [Rotation.from_rotvec(2 * np.pi * k / order * axis).as_matrix() for k in range(order)]
    return min(rotation_error_deg(R, R_true @ turn) for turn in turns)


def accuracy(predicted: Points, truth: Points) -> float:
    """Mean distance of predicted surface points from the true surface, meters."""
    return float(KDTree(truth).query(predicted)[0].mean())


def completeness(predicted: Points, truth: Points) -> float:
    """Mean distance of true surface points from the predicted surface, meters."""
    return accuracy(truth, predicted)


def chamfer_l1(predicted: Points, truth: Points) -> float:
    """(accuracy + completeness) / 2, meters."""
    return (accuracy(predicted, truth) + completeness(predicted, truth)) / 2
