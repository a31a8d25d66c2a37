"""A small depth camera as hand-held devices have it: frames of depth with noise, and what they truly show.

Noise grows with distance squared, disparity is quantized, pixels at depth edges and grazing ones are lost, and only
`nearest_m` to `farthest_m` is measured.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from trimesh.ray.ray_pyembree import RayMeshIntersector

from more2_jax.geometry.poses import Pose


@dataclass(frozen=True)
class DepthSensor:
    """A pinhole camera and its flaws; x right, y down, z forward."""

    width: int = 160  # pixels
    height: int = 120
    half_field_deg: float = 32.0  # half the horizontal field of view
    nearest_m: float = 0.4
    farthest_m: float = 4.5
    noise_m: float = 0.0012
    noise_per_m2: float = 0.0019  # added per (depth − 0.4 m)²
    disparity_step: float = 0.0029  # 1 / m: depth comes in steps of this times its square
    edge_m: float = 0.04  # neighbors further apart in depth, per meter of depth, make an edge
    edge_loss: tuple[float, float] = (
        0.25,
        0.8,
    )  # share of the pixels at an edge that are lost, near and far side
    dropout: float = 0.01
    grazing_deg: float = 80.0  # rays steeper than this against the surface return nothing

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return self.width / 2 / float(np.tan(np.deg2rad(self.half_field_deg)))

    @cached_property
    def rays(self) -> Float[np.ndarray, "p 3"]:
        """Directions of the pixels' middles, row by row, camera's frame; z = 1."""
        u, v = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        x, y = (u - self.width / 2) / self.focal, (v - self.height / 2) / self.focal
        return np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)

    def pixel(self, points: Float[np.ndarray, "n 3"]) -> tuple[Int[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """The pixel that shows each point of the camera's frame, row by row, and whether one does."""
        z = np.maximum(points[:, 2], 1e-6)
        u = np.floor(points[:, 0] / z * self.focal + self.width / 2)
        v = np.floor(points[:, 1] / z * self.focal + self.height / 2)
        inside = (points[:, 2] > 1e-6) & (u >= 0) & (u < self.width) & (v >= 0) & (v < self.height)
        return np.where(inside, v * self.width + u, 0).astype(np.int64), inside


@dataclass(frozen=True, kw_only=True)
class Frame:
    """What one frame truly shows, and what the sensor makes of it."""

    T_room_camera: Pose
    depth: Float[np.ndarray, " p"]  # true, meters along z, row by row; inf where nothing is hit
    face: Int[np.ndarray, " p"]  # of the room's mesh; −1 where nothing is hit
    measured: Float[np.ndarray, " p"] = field(repr=False)  # with noise; 0 where the sensor returns nothing


class FrameCaster:
    """Casts the frames of one visit: one ray tracer for the whole room."""

    def __init__(self, mesh: trimesh.Trimesh, sensor: DepthSensor) -> None:
        self.mesh, self.sensor = mesh, sensor
        self.caster = RayMeshIntersector(mesh)
        self.normals = np.asarray(mesh.face_normals)
        self.corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)[:, 0]]

    def frame(self, T_room_camera: Pose, rng: np.random.Generator) -> Frame:
        """What a camera there sees."""
        rays = self.sensor.rays @ T_room_camera[:3, :3].T
        eye = T_room_camera[:3, 3]
        face = np.asarray(self.caster.intersects_first(np.tile(eye, (len(rays), 1)), rays))
        hit = face >= 0
        normal = self.normals[face]
        facing = np.abs((normal * rays).sum(axis=1))
        toward = ((self.corners[face] - eye) * normal).sum(axis=1)
        depth = np.where(hit, np.abs(toward) / np.maximum(facing, 1e-9), np.inf)
        cosine = facing / np.linalg.norm(rays, axis=1)
        grazing = cosine < np.cos(np.deg2rad(self.sensor.grazing_deg))
        measured = measure(depth, self.sensor, rng)
        measured[grazing] = 0.0
        return Frame(
            T_room_camera=T_room_camera, depth=depth, face=np.where(hit, face, -1), measured=measured
        )


def measure(
    depth: Float[np.ndarray, " p"], sensor: DepthSensor, rng: np.random.Generator
) -> Float[np.ndarray, " p"]:
    """True depths (meters, row by row, inf for none) as the sensor reports them: 0 where it returns nothing."""
    # Drawn for every pixel, hit or not: a pixel that another processor sees otherwise changes no other one.
    noise, kept, edge_kept = rng.normal(size=depth.shape), rng.random(depth.shape), rng.random(depth.shape)
    known = np.isfinite(depth)
    z = np.where(known, depth, sensor.farthest_m * 2)
    noisy = z + noise * noise_std(z, sensor)
    steps = np.round(1 / np.maximum(noisy, 0.05) / sensor.disparity_step)
    quantized = 1 / np.maximum(steps * sensor.disparity_step, 1e-6)
    lost = (kept < sensor.dropout) | (edge_kept < at_edges(z, sensor))
    lost |= ~known | (quantized < sensor.nearest_m) | (quantized > sensor.farthest_m)
    return np.where(lost, 0.0, quantized)


def noise_std(depth: Float[np.ndarray, " p"], sensor: DepthSensor) -> Float[np.ndarray, " p"]:
    """Standard deviation of a depth, less quantization, meters."""
    return sensor.noise_m + sensor.noise_per_m2 * (depth - 0.4) ** 2


def at_edges(depth: Float[np.ndarray, " p"], sensor: DepthSensor) -> Float[np.ndarray, " p"]:
    """The chance that a pixel is lost because one of its four neighbors lies much nearer or farther."""
    image = depth.reshape(sensor.height, sensor.width)
    chance = np.zeros(image.shape)
    for axis in (0, 1):
        one, other = (np.delete(image, k, axis) for k in (-1, 0))
        jump = np.abs(one - other) > sensor.edge_m * np.minimum(one, other) + 0.02
        for closer, side in ((one < other, (0, 1)), (other < one, (1, 0))):
            near, far = (jump * loss for loss in sensor.edge_loss)
            pad = [(0, 0), (0, 0)]
            pad[axis] = side
            chance = np.maximum(chance, np.pad(np.where(closer, near, far), pad))
    return chance.ravel()
