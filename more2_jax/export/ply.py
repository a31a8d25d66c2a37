"""PLY: the accumulated points of all objects as one scan shows them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from more2_jax.export.placing import placed, state_in
from more2_jax.geometry.poses import apply_pose
from more2_jax.storage.ply_files import write_points
from more2_jax.tracking.objects import accumulated_points, number_of
from more2_jax.types import LivingScene


def write_ply(scene: LivingScene, path: Path, scan: int) -> None:
    """Points in the frame of `scan`, meters, z up; the vertex property `object` is the object's number.

    Objects that have no points because the scan did not look are named in comments of the header.
    """
    there = placed(scene, scan)
    clouds = [apply_pose(T_scan_ref, accumulated_points(o)) for _, o, T_scan_ref in there]
    points, numbers = np.concatenate(clouds), np.repeat([k for k, _, _ in there], [len(c) for c in clouds])
    states = {number_of(o): state_in(o, scene.scans[scan]) for o in scene.objects}
    comments = [f"not seen: object {k}" for k, state in states.items() if state == "not_seen"]
    write_points(path, points, numbers, "object", comments=comments)
