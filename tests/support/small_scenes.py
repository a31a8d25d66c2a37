"""A small scene of pieces without symmetry, and settings that register them in a moment."""

from __future__ import annotations

import dataclasses

import numpy as np
from factories import turn_z

from more2_jax.config import JointConfig, preset
from more2_jax.geometry.poses import apply_pose
from more2_jax.types import Instance, Mesh, Scan

MARK = Mesh(vertices=np.zeros((3, 3)), faces=np.array([[0, 1, 2]]))
ROBUST = preset("robust", upright=True)
SEARCH = dataclasses.replace(ROBUST.registration.search, turns=8, keep=2)
CONFIG = dataclasses.replace(
    ROBUST,
    matching=dataclasses.replace(ROBUST.matching, search=SEARCH),
    registration=dataclasses.replace(ROBUST.registration, search=SEARCH),
    joint=JointConfig(points=32, start="accumulated", steps=3),
    meshing=dataclasses.replace(ROBUST.meshing, coarse_resolution=16, resolution=16),
)


def piece(kind: int) -> np.ndarray:
    """Points of a shape without symmetry: a box face set with a fin, of a size of its own."""
    rng = np.random.default_rng(kind)
    size = np.array([[0.8, 0.4, 0.5], [1.6, 0.7, 0.4], [0.5, 0.5, 1.4]][kind])
    box = rng.uniform(-0.5, 0.5, (700, 3))
    box[np.arange(700), rng.integers(0, 3, 700)] = rng.choice([-0.5, 0.5], 700)
    fin = rng.uniform(0, 1, (200, 3)) * [0.1, 0.5, 0.9] + [0.35, 0, 0.5]
    return np.concatenate([box, fin]) * size


def scan(name: str, poses: dict[int, tuple[float, float]]) -> Scan:
    """Pieces by kind, each turned by an angle and put at (x, 0); ids are 10 + kind."""
    instances = []
    for kind, (angle, x) in poses.items():
        turn = turn_z(angle, np.zeros(3), np.array([x, 0.0, 0.0]))
        instances.append(Instance(id=10 + kind, points=apply_pose(turn, piece(kind)), label=f"kind {kind}"))
    return Scan(name=name, source=name, instances=tuple(instances))


def in_frame(s: Scan, T: np.ndarray) -> Scan:
    """The scan in another frame."""
    instances = tuple(dataclasses.replace(i, points=apply_pose(T, i.points)) for i in s.instances)
    return dataclasses.replace(s, instances=instances, background=apply_pose(T, s.background))


def room(floor_m: float, seed: int) -> np.ndarray:
    """Points of a floor and of two walls."""
    rng = np.random.default_rng(seed)
    floor, wall = rng.uniform(0, 1, (2, 3000, 3)) * [10, 6, 0], rng.uniform(0, 1, (2, 2000, 3)) * [10, 0, 2.5]
    other = rng.uniform(0, 1, (2000, 3)) * [0, 6, 2.5]
    return np.concatenate([floor[0], wall[0], other]) + [-2, -3, floor_m] + rng.normal(0, 0.005, (7000, 3))
