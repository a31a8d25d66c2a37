"""Rooms of furniture scanned by a depth camera, with ground truth: FlyingShape (paper §4) with what real scans add.

Every object's pose, every point's object and every model are known. Deterministic by seed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from trimesh.ray.ray_pyembree import RayMeshIntersector

from more2_jax.geometry.poses import Pose

Camera = tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]  # eye, unit viewing direction; room frame


@dataclass(frozen=True)
class SensorConfig:
    """A depth camera at head height. Its noise grows with distance squared, as structured light's does."""

    cameras: int = 8
    width: int = 280  # pixels
    height: int = 210
    half_field_deg: float = 38.0  # half the horizontal field of view
    height_m: float = 1.5
    noise_m: float = 0.0012
    noise_per_m2: float = 0.0019  # added per (distance − 0.4 m)²
    dropout: float = 0.02
    grazing_deg: float = 80.0  # rays steeper than this against the surface return nothing


@dataclass(frozen=True, kw_only=True)
class PlacedMesh:
    """A model in the room: `T_room_model` maps its vertices (meters) into the room."""

    model: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    T_room_model: Pose


def footprint_radius(vertices: Float[np.ndarray, "v 3"]) -> float:
    """Radius about the model's origin that holds its footprint, meters."""
    return float(np.linalg.norm(vertices[:, :2], axis=1).max())


def free_spot(
    rng: np.random.Generator,
    radius: float,
    taken: Sequence[tuple[float, float, float]],
    room: tuple[float, float],
) -> tuple[float, float]:
    """A place whose circle touches no other's (x, y, radius) and no wall; ValueError if none is found."""
    for _ in range(300):
        x, y = (rng.uniform(-side / 2 + radius, side / 2 - radius) for side in room)
        if all((x - a) ** 2 + (y - b) ** 2 > (radius + r) ** 2 for a, b, r in taken):
            return float(x), float(y)
    raise ValueError(f"no free spot of radius {radius:.2f} m in a room of {room[0]} × {room[1]} m")


def scan_room(
    placed: Sequence[PlacedMesh], room: tuple[float, float], config: SensorConfig, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """What cameras around the room see: points (meters, room frame) and the object each lies on, −1 for the floor.

    `room` is the furnished floor, x by y meters about the origin; the cameras stand around it.
    """
    return RoomCaster(placed, room).scan(camera_poses(room, config, rng), config, rng)


class RoomCaster:
    """Casts rays into a room: one ray tracer for all of its objects and, if there is one, its floor."""

    def __init__(self, placed: Sequence[PlacedMesh], floor: tuple[float, float] | None) -> None:
        """`floor` is x by y meters about the origin; None for objects on nothing."""
        vertices, faces, owner = [], [], []
        if floor is not None:
            box = trimesh.creation.box(extents=(*floor, 0.1))
            vertices.append(np.asarray(box.vertices) - [0, 0, 0.05])
            faces.append(np.asarray(box.faces))
            owner.append(np.full(len(box.faces), -1))
        for k, thing in enumerate(placed):
            faces.append(thing.faces + sum(map(len, vertices)))
            vertices.append(thing.vertices @ thing.T_room_model[:3, :3].T + thing.T_room_model[:3, 3])
            owner.append(np.full(len(thing.faces), k))
        self.mesh = trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)
        self.owner: Int[np.ndarray, " f"] = np.concatenate(owner)
        self.caster = RayMeshIntersector(self.mesh)
        self.balls = None if floor is not None else [ball(v) for v in vertices]

    def scan(
        self, cameras: Sequence[Camera], config: SensorConfig, rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
        """What the cameras see: points (meters, room frame) and the object each lies on, −1 for the floor."""
        seen = [self._view(*camera, config, rng) for camera in cameras]
        points, objects = (np.concatenate(part) for part in zip(*seen, strict=True))
        return points, objects

    def _view(
        self, eye: np.ndarray, forward: np.ndarray, config: SensorConfig, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        rays = pixel_directions(forward, config)
        # Drawn for every pixel, hit or not: a pixel that another processor sees otherwise changes no other one.
        kept_by_sensor, noise = rng.random(len(rays)) > config.dropout, rng.normal(size=len(rays))
        cast = np.flatnonzero(kept_by_sensor & self._may_hit(eye, rays))
        hits, ray, face = self.caster.intersects_location(
            np.tile(eye, (len(cast), 1)), rays[cast], multiple_hits=False
        )
        ray = cast[ray]
        facing = np.abs((self.mesh.face_normals[face] * rays[ray]).sum(axis=1))
        kept = facing > np.cos(np.deg2rad(config.grazing_deg))
        hits, ray, face = hits[kept], ray[kept], face[kept]
        distance = np.linalg.norm(hits - eye, axis=1)
        std = config.noise_m + config.noise_per_m2 * (distance - 0.4) ** 2
        return hits + rays[ray] * (std * noise[ray])[:, None], self.owner[face]

    def _may_hit(self, eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Whether a ray meets the ball about some object: without a floor, most rays meet none."""
        if self.balls is None:
            return np.ones(len(rays), bool)
        may = np.zeros(len(rays), bool)
        for middle, radius in self.balls:
            along = rays @ (middle - eye)
            off = ((middle - eye) ** 2).sum() - along**2
            may |= (off < radius**2) & (along > 0)
        return may

    def sees(
        self,
        cameras: Sequence[Camera],
        config: SensorConfig,
        points: Float[np.ndarray, "p 3"],
        tolerance_m: float = 0.004,
    ) -> Bool[np.ndarray, " p"]:
        """Which surface points (room frame) some camera sees: in its field, not grazing, nothing in front."""
        seen = np.zeros(len(points), bool)
        for eye, forward in cameras:
            left = np.flatnonzero(~seen)
            left = left[in_field(points[left] - eye, forward, config)]
            ray = points[left] - eye
            length = np.linalg.norm(ray, axis=1)
            hits, index, face = self.caster.intersects_location(
                np.tile(eye, (len(ray), 1)), ray / length[:, None], multiple_hits=False
            )
            near = np.abs(np.linalg.norm(hits - eye, axis=1) - length[index]) < tolerance_m
            facing = np.abs((self.mesh.face_normals[face] * ray[index]).sum(axis=1)) / length[index]
            seen[left[index[near & (facing > np.cos(np.deg2rad(config.grazing_deg)))]]] = True
        return seen


def ball(vertices: Float[np.ndarray, "v 3"]) -> tuple[np.ndarray, float]:
    """Middle and radius of a ball that holds the vertices, a little larger than it must be."""
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return middle, 1.001 * float(np.linalg.norm(vertices - middle, axis=1).max())


def camera_poses(room: tuple[float, float], config: SensorConfig, rng: np.random.Generator) -> list[Camera]:
    """Eye and viewing direction of every camera: around the furniture, looking across and down."""
    start = rng.uniform(0, 2 * np.pi)
    cameras = []
    for k in range(config.cameras):
        angle = start + 2 * np.pi * k / config.cameras + rng.normal(0, 0.1)
        eye = np.array([0.6 * room[0] * np.cos(angle), 0.6 * room[1] * np.sin(angle), config.height_m])
        cameras.append(looking(eye, np.array([*rng.uniform(-0.15, 0.15, 2) * room, 0.45])))
    return cameras


def looking(eye: Float[np.ndarray, " 3"], target: Float[np.ndarray, " 3"]) -> Camera:
    """The camera at `eye` that looks at `target`."""
    return eye, (target - eye) / np.linalg.norm(target - eye)


def camera_axes(forward: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Columns right, down, forward of a level camera; of one that looks straight down, right is +x or so."""
    up = np.array([0.0, 0, 1]) if abs(forward[2]) < 0.999 else np.array([0.0, 1, 0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def camera_matrix(camera: Camera) -> Pose:
    """T_room_camera; in the camera's frame x points right, y down, z forward."""
    T_room_camera = np.eye(4)
    T_room_camera[:3, :3], T_room_camera[:3, 3] = camera_axes(camera[1]), camera[0]
    return T_room_camera


def pixel_directions(forward: np.ndarray, config: SensorConfig) -> Float[np.ndarray, "r 3"]:
    """Unit directions of the pixels' rays, row by row."""
    right, down, _ = camera_axes(forward).T
    half = np.tan(np.deg2rad(config.half_field_deg))
    x = np.linspace(-half, half, config.width)
    y = np.linspace(-half, half, config.height) * config.height / config.width
    grid_x, grid_y = np.meshgrid(x, y)
    rays = (forward + grid_x[..., None] * right + grid_y[..., None] * down).reshape(-1, 3)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def in_field(
    rays: Float[np.ndarray, "r 3"], forward: np.ndarray, config: SensorConfig
) -> Bool[np.ndarray, " r"]:
    """Which directions (of any length) fall onto the image."""
    x, y, z = (rays @ camera_axes(forward)).T
    half = np.tan(np.deg2rad(config.half_field_deg)) * z
    return (z > 0) & (np.abs(x) <= half) & (np.abs(y) <= half * config.height / config.width)
