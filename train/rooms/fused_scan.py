"""One visit scanned by hand: frames along a walk, fused where the device believes to be, labeled and masked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import point_cloud_utils as pcu
from jaxtyping import Float, Int

from more2_jax.geometry.poses import Pose, apply_pose
from train.rooms.coloring import Light
from train.rooms.depth_sensor import DepthSensor, Frame, FrameCaster
from train.rooms.fusion import ColoredMesh, fuse
from train.rooms.hand_held import Walk, drifted
from train.rooms.mask_flaws import Masks, draw_flaws, predicted_masks
from train.rooms.over_segmentation import majority, over_segmentation
from train.rooms.whole_room import WholeRoom

MARGIN_M = 0.2  # about the room: walls drift outward


@dataclass(frozen=True)
class ScanSettings:
    """How a visit is scanned and fused."""

    sensor: DepthSensor = field(default_factory=DepthSensor)
    walk: Walk = field(default_factory=Walk)
    voxel_m: tuple[float, float] = (0.02, 0.03)  # of the fusion, least and most
    kept_faces: tuple[float, float] = (0.4, 0.8)  # share that decimation leaves, least and most
    masks: Masks = "perfect"

    def with_noise(self, factor: float) -> ScanSettings:
        """The same with so many times the noise of depth, and the drift of every frame."""
        sensor, walk = self.sensor, self.walk
        return replace(
            self,
            sensor=replace(
                sensor, noise_m=factor * sensor.noise_m, noise_per_m2=factor * sensor.noise_per_m2
            ),
            walk=replace(walk, step_m=factor * walk.step_m, step_deg=factor * walk.step_deg),
        )


@dataclass(frozen=True, kw_only=True)
class FusedScan:
    """A scan as a user has it, in its own frame, with what is true of every vertex."""

    mesh: ColoredMesh
    instance: Int[np.ndarray, " v"]  # predicted; 0: none
    owner: Int[np.ndarray, " v"]  # the object whose true surface is nearest; −1: none
    T_scan_room: Pose


def take_frames(
    room: WholeRoom, path: Float[np.ndarray, "f 4 4"], sensor: DepthSensor, rng: np.random.Generator
) -> list[Frame]:
    """What the sensor sees along a path of true poses."""
    caster = FrameCaster(room.mesh, sensor)
    return [caster.frame(T, rng) for T in path]


def fused_scan(
    room: WholeRoom,
    frames: Sequence[Frame],
    count: int,
    T_scan_room: Pose,
    settings: ScanSettings,
    rng: np.random.Generator,
) -> FusedScan:
    """The scan that frames of a room with `count` objects make. ValueError if they show nothing."""
    mesh = _fused(room, frames, settings, rng)
    faces = np.asarray(room.mesh.faces, np.int64)
    nearest = pcu.closest_points_on_mesh(mesh.vertices, np.asarray(room.mesh.vertices), faces)[1]
    owner = room.owner[nearest]
    piece = over_segmentation(mesh.vertices, mesh.normals, mesh.faces)
    label = majority(piece, owner)
    flaws = dict(enumerate(draw_flaws(count, settings.masks, rng)))
    return FusedScan(
        mesh=replace(mesh, vertices=apply_pose(T_scan_room, mesh.vertices)),
        instance=predicted_masks(mesh.vertices, label, flaws, rng),
        owner=owner,
        T_scan_room=T_scan_room,
    )


def _fused(
    room: WholeRoom, frames: Sequence[Frame], settings: ScanSettings, rng: np.random.Generator
) -> ColoredMesh:
    """The mesh in the room's frame, as the device believes that frame to lie."""
    light, normals = Light.drawn(rng), np.asarray(room.mesh.face_normals)
    believed = drifted(np.stack([f.T_room_camera for f in frames]), settings.walk, rng)
    low, high = room.mesh.bounds
    box = np.asarray(low) - MARGIN_M, np.asarray(high) + MARGIN_M
    voxel_m, kept_faces = rng.uniform(*settings.voxel_m), rng.uniform(*settings.kept_faces)
    shots = (
        (f.measured, light.developed(room.color[f.face], normals[f.face], rng), T)
        for f, T in zip(frames, believed, strict=True)
    )
    return fuse(shots, settings.sensor, box, float(voxel_m), float(kept_faces))
