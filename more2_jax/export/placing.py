"""Where objects lie in a scan, and the node that carries each."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from more2_jax.tracking.objects import accumulated_points, observation_in, place_of
from more2_jax.types import LivingScene, SceneObject


def pose_in(o: SceneObject, scan: int) -> Float[np.ndarray, "4 4"] | None:
    """T_scan_ref: takes an object's mesh and points to where they lie in a scan; None if absent."""
    seen = observation_in(o, scan)
    return None if seen is None else np.linalg.inv(seen.T_ref_scan)


def placed(scene: LivingScene, scan: int) -> list[tuple[int, SceneObject, Float[np.ndarray, "4 4"]]]:
    """Number, object and T_scan_ref of all objects in a scan. Raises ValueError if there is none."""
    poses = [(k, o, pose_in(o, scan)) for k, o in enumerate(scene.objects)]
    there = [(k, o, T) for k, o, T in poses if T is not None]
    if not there:
        raise ValueError(f"scan {scan} ({scene.scans[scan].name}) shows no object; needed another scan")
    return there


@dataclass(frozen=True, kw_only=True)
class Track:
    """An object as a node that moves: geometry about its own center, and a pose for every scan.

    Files hold geometry in single precision; about its own center it keeps its micrometers however far from
    the world's zero it lies. Poses are in the scene's frame, which its scans may not share. Where the object
    is absent its pose is the last one seen, or the first.
    """

    vertices: Float[np.ndarray, "v 3"]  # meters, relative to the node
    T_scene_node: Float[np.ndarray, "scans 4 4"]
    present: Bool[np.ndarray, " scans"]


def track(o: SceneObject, scans: int) -> Track:
    """The node of one object over all scans: its mesh, or its accumulated points without one."""
    vertices = accumulated_points(o) if o.mesh is None else o.mesh.vertices
    T_ref_node = np.eye(4)
    T_ref_node[:3, 3] = vertices.mean(axis=0)
    seen = [observation_in(o, s) for s in range(scans)]
    poses = [None if s is None else place_of(s) for s in seen]
    held = next(T for T in poses if T is not None)
    filled = [held := held if T is None else T for T in poses]
    return Track(
        vertices=vertices - T_ref_node[:3, 3],
        T_scene_node=np.stack([T @ T_ref_node for T in filled]),
        present=np.array([T is not None for T in poses]),
    )


def quaternions(poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4"]:
    """Rotations as x, y, z, w; neighbors are on one side, so that going from one to the next is the short way."""
    result = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    for before, after in itertools.pairwise(result):
        after *= -1.0 if before @ after < 0 else 1.0
    return result
