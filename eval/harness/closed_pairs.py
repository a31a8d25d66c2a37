"""Registered pairs as a living scene has them in the end: both observations aligned with one another (`pose_graph`)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from eval.scores.pose_scores import Pose
from more2_jax.config import SceneConfig
from more2_jax.geometry.poses import apply_pose
from more2_jax.network.prior import Prior
from more2_jax.refinement.pose_graph_of_objects import refine_object_poses
from more2_jax.tracking.object_views import few_sensors
from more2_jax.tracking.room_points import remembered
from more2_jax.types import AccumulatedObject, Embedding, Scan

Cloud = np.ndarray  # (n, 3), meters, in its scan's frame


def closed_poses(
    prior: Prior,
    clouds: Sequence[tuple[Cloud, Cloud]],
    scans: Sequence[tuple[Scan, Scan]],
    codes: Sequence[Embedding],
    poses: Sequence[Pose],
    config: SceneConfig,
) -> list[Pose]:
    """The poses T_target_source after closing, of pairs of source and target; `codes` are of the targets."""
    objects = [seen_twice(*seen) for seen in zip(clouds, scans, codes, poses, strict=True)]
    return [o.poses[1] for o in refine_object_poses(prior, objects, config)]


def seen_twice(
    clouds: tuple[Cloud, Cloud], scans: tuple[Scan, Scan], code: Embedding, T_target_source: Pose
) -> AccumulatedObject:
    """A pair as one object: the target first, and the source as it was registered onto it."""
    (source, target), (later, first) = clouds, scans
    T = np.asarray(T_target_source)
    return AccumulatedObject(
        points=np.concatenate([target, apply_pose(T, source)]),
        observation=np.repeat([0, 1], [len(target), len(source)]),
        poses=np.stack([np.eye(4), T]),
        embedding=code,
        sensors=(few_sensors(first), few_sensors(later)),
        background=remembered(first.background),
    )
