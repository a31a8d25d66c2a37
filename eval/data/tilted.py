"""Scans tilted by exactly so much against gravity, each another way, whatever they were before; and leveled ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from eval.data.truth import KnownScene
from more2_jax.geometry.gravity import least_turn
from more2_jax.geometry.poses import Pose, apply_pose
from more2_jax.tracking.leveling import is_level, level_of, leveled
from more2_jax.tracking.room_points import remembered


def tilted(scene: KnownScene, tilt_deg: float, seed: int = 0) -> KnownScene:
    """The scene, every scan turned about its middle so that up is `tilt_deg` off z.

    Up is where the objects' models have it. Raises ValueError where these do not agree: objects in any orientation.
    """
    rng = np.random.default_rng((seed, *scene.name.encode()))
    turns = [_tilt(scene, k, tilt_deg, rng.uniform(0, 2 * np.pi)) for k in range(len(scene.scans))]
    return turned_scans(scene, turns)


def leveled_scans(scene: KnownScene) -> KnownScene:
    """The scene, every scan leveled by its floors as the method levels those of a living scene."""
    first = level_of(remembered(scene.scans[0].background))
    later = (level_of(remembered(s.background), first) for s in scene.scans[1:])
    return turned_scans(scene, [first, *later])


def turned_scans(scene: KnownScene, turns: Sequence[Pose]) -> KnownScene:
    """The scene, every scan and what is true of it moved by a pose."""
    if all(map(is_level, turns)):
        return scene
    objects = [
        replace(o, T_scan_model={k: turns[k] @ T for k, T in o.T_scan_model.items()}) for o in scene.objects
    ]
    points = scene.true_points
    if points:
        points = tuple(
            {name: apply_pose(T, p) for name, p in known.items()}
            for T, known in zip(turns, points, strict=True)
        )
    scans = tuple(leveled(s, T) for s, T in zip(scene.scans, turns, strict=True))
    return replace(scene, scans=scans, objects=tuple(objects), true_points=points)


def _tilt(scene: KnownScene, k: int, tilt_deg: float, way: float) -> Pose:
    ups = np.array([o.T_scan_model[k][:3, 2] for o in scene.objects if k in o.T_scan_model])
    if not len(ups) or (ups @ ups[0] < np.cos(np.deg2rad(1.0))).any():
        raise ValueError(
            f"{scene.name}, scan {k}: no common up of its objects; needed upright rooms for --tilt"
        )
    scan = scene.scans[k]
    middle = np.median(np.concatenate([scan.background, *(i.points for i in scan.instances)]), axis=0)
    turn = Rotation.from_rotvec(tilt_deg * np.array([np.cos(way), np.sin(way), 0.0]), degrees=True)
    T = np.eye(4)
    T[:3, :3] = turn.as_matrix() @ least_turn(ups.mean(axis=0) / np.linalg.norm(ups.mean(axis=0)))
    T[:3, 3] = middle - T[:3, :3] @ middle
    return T
