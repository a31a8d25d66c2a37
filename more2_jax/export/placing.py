"""Where objects lie in a scan, and the node that carries each."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from more2_jax.tracking.objects import accumulated_points, number_of, observation_in, place_of
from more2_jax.types import LivingScene, ScanRecord, SceneObject

State = Literal["seen", "not_seen", "absent"]  # of an object in a scan
PALE = 0.22  # opacity of an object where it stood last, in scans that did not look there; as on the page


def pose_in(o: SceneObject, scan: int) -> Float[np.ndarray, "4 4"] | None:
    """T_scan_ref: takes an object's mesh and points to where they lie in a scan; None if absent."""
    seen = observation_in(o, scan)
    return None if seen is None else np.linalg.inv(seen.T_ref_scan)


def placed(scene: LivingScene, scan: int) -> list[tuple[int, SceneObject, Float[np.ndarray, "4 4"]]]:
    """Number, object and T_scan_ref of all objects in a scan. Raises ValueError if there is none."""
    poses = [(number_of(o), o, pose_in(o, scan)) for o in scene.objects]
    there = [(k, o, T) for k, o, T in poses if T is not None]
    if not there:
        raise ValueError(f"scan {scan} ({scene.scans[scan].name}) shows no object; needed another scan")
    return there


@dataclass(frozen=True, kw_only=True)
class Track:
    """An object as a node that moves: geometry about its own center, and a pose for every scan.

    Files hold geometry in single precision; about its own center it keeps its micrometers however far from
    the world's zero it lies. Poses are in the scene's frame, which its scans may not share. Where the object
    is not seen or absent its pose is the last one seen, or the first.
    """

    vertices: Float[np.ndarray, "v 3"]  # meters, relative to the node
    T_scene_node: Float[np.ndarray, "scans 4 4"]
    states: tuple[State, ...]  # one a scan

    def shown(self, state: State) -> Bool[np.ndarray, " scans"]:
        """In which scans the object is in a state."""
        return np.array([s == state for s in self.states])

    def poses(self, state: State) -> Float[np.ndarray, "scans 4 4"]:
        """T_scene_node of the node that shows this state; what shows where an object was does not glide away."""
        if state == "seen":
            return self.T_scene_node
        held = self.T_scene_node[0]
        shown = zip(self.T_scene_node, self.shown(state), strict=True)
        return np.stack([held := T if there else held for T, there in shown])


def state_in(o: SceneObject, scan: ScanRecord) -> State:
    """Whether a scan shows an object, cannot tell whether it is there (`tracking.looked_at`), or has none of it."""
    if observation_in(o, scan.index) is not None:
        return "seen"
    return "not_seen" if o.id in scan.not_seen else "absent"


def track(o: SceneObject, scans: Sequence[ScanRecord]) -> Track:
    """The node of one object over all scans: its mesh, or its accumulated points without one."""
    vertices = accumulated_points(o) if o.mesh is None else o.mesh.vertices
    T_ref_node = np.eye(4)
    T_ref_node[:3, 3] = vertices.mean(axis=0)
    seen = [observation_in(o, s.index) for s in scans]
    poses = [None if s is None else place_of(s) for s in seen]
    held = next(T for T in poses if T is not None)
    filled = [held := held if T is None else T for T in poses]
    return Track(
        vertices=vertices - T_ref_node[:3, 3],
        T_scene_node=np.stack([T @ T_ref_node for T in filled]),
        states=tuple(state_in(o, s) for s in scans),
    )


def quaternions(poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4"]:
    """Rotations as x, y, z, w; neighbors are on one side, so that going from one to the next is the short way."""
    result = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    for before, after in itertools.pairwise(result):
        after *= -1.0 if before @ after < 0 else 1.0
    return result
