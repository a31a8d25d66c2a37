"""Registered pairs as a living scene has them in the end: both observations aligned with one another (`pose_graph`)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from eval.scores.pose_scores import Pose
from more2_jax.config import SceneConfig
from more2_jax.meshing.object_mesh import object_floor
from more2_jax.network.prior import Prior
from more2_jax.refinement.pose_graph_of_objects import refine_object_poses
from more2_jax.scene import record
from more2_jax.tracking.objects import new_object, seen_again
from more2_jax.types import Embedding, Instance, Observation, Scan, ScanRecord, SceneObject

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
    objects: list[SceneObject] = []
    records: list[ScanRecord] = []
    for k, ((source, target), (later, first), T) in enumerate(zip(clouds, scans, poses, strict=True)):
        records += [record(2 * k, first, [], ()), record(2 * k + 1, later, [], ())]
        seen = Observation(
            scan=2 * k + 1, instance=0, T_ref_scan=np.asarray(T), score=1.0, rms_m=0.0, converged=True
        )
        o = new_object(k, 2 * k, Instance(id=0, points=target), codes[k])
        objects.append(seen_again(o, Instance(id=0, points=source), seen))
    floors = {k: object_floor(o, records, config) for k, o in enumerate(objects)}
    closed = refine_object_poses(prior, objects, range(len(objects)), records, floors, config)
    return [o.observations[1].T_ref_scan for o in closed]
