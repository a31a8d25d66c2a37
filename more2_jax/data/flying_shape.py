"""Rooms of furniture scanned by a depth camera, with ground truth: METHOD 7 with what real scans add.

Every object's pose, every point's object and every model are known. Deterministic by seed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from trimesh.ray.ray_pyembree import RayMeshIntersector

from more2_jax.data.depth_views import DISTANCE, pixel_rays
from more2_jax.data.solids import canonical

Pose = Float[np.ndarray, "4 4"]


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
    """A model in the room: `T_room_model` maps its vertices (metres) into the room."""

    model: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    T_room_model: Pose


def upright_pose(yaw: float, x: float, y: float) -> Pose:
    """Standing on the floor at (x, y), turned by `yaw` radians."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    pose[:2, 3] = x, y
    return pose


def footprint_radius(vertices: Float[np.ndarray, "v 3"]) -> float:
    """Radius about the model's origin that holds its footprint, metres."""
    return float(np.linalg.norm(vertices[:, :2], axis=1).max())


def free_spot(
    rng: np.random.Generator,
    radius: float,
    taken: Sequence[tuple[float, float, float]],
    room: tuple[float, float],
) -> tuple[float, float]:
    """A place whose circle touches no other's (x, y, radius) and no wall; ValueError if none is found."""
    for _ in range(2000):
        x, y = (rng.uniform(-side / 2 + radius, side / 2 - radius) for side in room)
        if all((x - a) ** 2 + (y - b) ** 2 > (radius + r) ** 2 for a, b, r in taken):
            return float(x), float(y)
    raise ValueError(f"no free spot of radius {radius:.2f} m in a room of {room[0]} × {room[1]} m")


def scan_room(
    placed: Sequence[PlacedMesh], room: tuple[float, float], config: SensorConfig, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """What the cameras see: points (metres, room frame) and the object each lies on, −1 for the floor.

    `room` is the furnished floor, x by y metres about the origin; the cameras stand around it.
    """
    mesh, owner = _assemble(placed, room)
    caster = RayMeshIntersector(mesh)
    seen = [
        _one_view(caster, mesh, owner, *camera, config, rng) for camera in camera_poses(room, config, rng)
    ]
    points, objects = (np.concatenate(part) for part in zip(*seen, strict=True))
    return points, objects


def hemisphere_scan(
    placed: Sequence[PlacedMesh], rng: np.random.Generator, views: int = 3
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Every object alone from random viewpoints above it, no noise (METHOD 7); as `scan_room` returns it."""
    points, objects = [], []
    for index, thing in enumerate(placed):
        mesh = trimesh.Trimesh(thing.vertices, thing.faces, process=False)
        mesh.apply_transform(thing.T_room_model)
        vertices, scale = canonical(mesh.vertices)
        caster = RayMeshIntersector(trimesh.Trimesh(vertices, thing.faces, process=False))
        for toward in rng.normal(size=(views, 3)):
            toward = np.array([*toward[:2], abs(toward[2])]) / np.linalg.norm(toward)
            rays = pixel_rays(toward)
            eyes = np.tile(DISTANCE * toward, (len(rays), 1))
            hits, _, _ = caster.intersects_location(eyes, rays, multiple_hits=False)
            points.append(hits * scale + mesh.bounds.mean(axis=0))
            objects.append(np.full(len(hits), index))
    return np.concatenate(points), np.concatenate(objects)


def _assemble(placed: Sequence[PlacedMesh], room: tuple[float, float]) -> tuple[trimesh.Trimesh, np.ndarray]:
    floor = trimesh.creation.box(extents=(room[0], room[1], 0.1))
    floor.apply_translation((0, 0, -0.05))
    vertices, faces = [np.asarray(floor.vertices)], [np.asarray(floor.faces)]
    for thing in placed:
        R, t = thing.T_room_model[:3, :3], thing.T_room_model[:3, 3]
        faces.append(thing.faces + sum(map(len, vertices)))
        vertices.append(thing.vertices @ R.T + t)
    owner = np.repeat(np.arange(-1, len(placed)), [len(f) for f in faces])
    return trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False), owner


def camera_poses(
    room: tuple[float, float], config: SensorConfig, rng: np.random.Generator
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Eye and viewing direction of every camera: around the furniture, looking across and down."""
    start = rng.uniform(0, 2 * np.pi)
    cameras = []
    for k in range(config.cameras):
        angle = start + 2 * np.pi * k / config.cameras + rng.normal(0, 0.1)
        eye = np.array([0.6 * room[0] * np.cos(angle), 0.6 * room[1] * np.sin(angle), config.height_m])
        target = np.array([*rng.uniform(-0.15, 0.15, 2) * room, 0.45])
        cameras.append((eye, (target - eye) / np.linalg.norm(target - eye)))
    return cameras


def _one_view(
    caster: RayMeshIntersector,
    mesh: trimesh.Trimesh,
    owner: np.ndarray,
    eye: np.ndarray,
    forward: np.ndarray,
    config: SensorConfig,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    rays = _rays(forward, config)
    hits, ray, face = caster.intersects_location(np.tile(eye, (len(rays), 1)), rays, multiple_hits=False)
    facing = np.abs((mesh.face_normals[face] * rays[ray]).sum(axis=1))
    kept = (facing > np.cos(np.deg2rad(config.grazing_deg))) & (rng.random(len(hits)) > config.dropout)
    hits, ray, face = hits[kept], ray[kept], face[kept]
    distance = np.linalg.norm(hits - eye, axis=1)
    std = config.noise_m + config.noise_per_m2 * (distance - 0.4) ** 2
    return hits + rays[ray] * (std * rng.normal(size=len(hits)))[:, None], owner[face]


def _rays(forward: np.ndarray, config: SensorConfig) -> Float[np.ndarray, "r 3"]:
    right = np.cross(forward, [0.0, 0, 1])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    half = np.tan(np.deg2rad(config.half_field_deg))
    x = np.linspace(-half, half, config.width)
    y = np.linspace(-half, half, config.height) * config.height / config.width
    grid_x, grid_y = np.meshgrid(x, y)
    rays = (forward + grid_x[..., None] * right + grid_y[..., None] * down).reshape(-1, 3)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def yaw_symmetry(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], tolerance: float = 0.015, seed: int = 0
) -> int:
    """Order of the symmetry about the vertical: 1 none, 2, 4, or 0 for any angle; measured on the surface.

    A turn counts when the 90th percentile of the distance between turned and unturned surface is below
    `tolerance` of the diagonal.
    """
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    points = trimesh.sample.sample_surface(mesh, 8000, seed=seed)[0]
    tree, diagonal = KDTree(points), np.linalg.norm(np.ptp(points, axis=0))

    def same(degrees: float) -> bool:
        turned = points @ Rotation.from_euler("z", degrees, degrees=True).as_matrix().T
        return bool(np.quantile(tree.query(turned)[0], 0.9) < tolerance * diagonal)

    if all(same(angle) for angle in (23.0, 51.0, 77.0)):
        return 0
    return 4 if same(90) else 2 if same(180) else 1
