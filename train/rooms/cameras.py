"""Where the depth cameras of a visit stand: above the furniture, or inside the room at a person's height."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from train.rooms.ray_scanner import Camera, SensorConfig, looking

CLEAN = SensorConfig(
    cameras=3, width=720, height=540, noise_m=0.0, noise_per_m2=0.0, dropout=0.0, grazing_deg=89.0
)
SPARSE = SensorConfig(cameras=3, width=240, height=180)
SECTOR_DEG = 70.0  # two neighboring cameras inside the room stand at most so far apart, seen from its middle
CLEARANCE_M = 0.35  # between a camera and the circle about any object


def hemisphere_cameras(
    radius_m: float, config: SensorConfig, rng: np.random.Generator, lowest_deg: float = 10.0
) -> list[Camera]:
    """Cameras at random on the upper hemisphere, looking at its middle; all of `radius_m` about it is seen."""
    half = np.tan(np.deg2rad(config.half_field_deg)) * min(1.0, config.height / config.width)
    distance = radius_m / np.sin(np.arctan(half))
    cameras = []
    for _ in range(config.cameras):
        z, angle = rng.uniform(np.sin(np.deg2rad(lowest_deg)), 1.0), rng.uniform(0, 2 * np.pi)
        ring = np.sqrt(1 - z * z)
        eye = distance * np.array([ring * np.cos(angle), ring * np.sin(angle), z])
        cameras.append(looking(np.round(eye, 6), np.zeros(3)))
    return cameras


def inside_cameras(
    room: tuple[float, float],
    taken: Sequence[tuple[float, float, float]],
    config: SensorConfig,
    rng: np.random.Generator,
) -> list[Camera]:
    """Cameras on one side of the room, none within an object's circle (x, y, radius), looking across.

    Raises ValueError if there is nowhere to stand.
    """
    start = rng.uniform(0, 2 * np.pi)
    return [
        looking(
            _place(room, taken, config, rng, start + np.deg2rad(SECTOR_DEG) * k / 2),
            np.array([*np.round(rng.uniform(-0.2, 0.2, 2) * room, 6), 0.4]),
        )
        for k in range(config.cameras)
    ]


def _place(
    room: tuple[float, float],
    taken: Sequence[tuple[float, float, float]],
    config: SensorConfig,
    rng: np.random.Generator,
    angle: float,
) -> np.ndarray:
    """A free place near the wall in a direction from the middle."""
    for _ in range(200):
        toward = angle + np.deg2rad(SECTOR_DEG) / 2 * rng.uniform(-0.5, 0.5)
        x, y = rng.uniform(0.36, 0.49) * np.array(room) * (np.cos(toward), np.sin(toward)) * np.sqrt(2)
        x, y = np.clip(x, -0.49 * room[0], 0.49 * room[0]), np.clip(y, -0.49 * room[1], 0.49 * room[1])
        if all((x - a) ** 2 + (y - b) ** 2 > (r + CLEARANCE_M) ** 2 for a, b, r in taken):
            height = config.height_m + rng.uniform(-0.15, 0.15)
            return np.round([x, y, height], 6)
    raise ValueError(f"nowhere to stand for a camera in a room of {room[0]} × {room[1]} m; needed more room")
