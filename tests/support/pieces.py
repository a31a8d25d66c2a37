"""Furniture that no training used, as points on its surface; and poses to put it in."""

from functools import cache

import numpy as np
import trimesh
from places import DATA
from scipy.spatial.transform import Rotation

from train.furniture.collections import SourceMesh, read_meshes, standing
from train.furniture.symmetry import yaw_symmetry

FURNITURE = DATA / "unseen_furniture.npz"


@cache
def furniture() -> tuple[SourceMesh, ...]:
    """Every piece."""
    return tuple(read_meshes(FURNITURE))


@cache
def without_symmetry() -> tuple[SourceMesh, ...]:
    """The pieces that no turn about the vertical maps onto themselves."""
    return tuple(m for m in furniture() if yaw_symmetry(m.vertices, m.faces) == 1)


def surface(mesh: SourceMesh, count: int, seed: int = 0) -> np.ndarray:
    """Points on the surface of a piece standing on z = 0, meters."""
    solid = trimesh.Trimesh(standing(mesh.vertices), mesh.faces, process=False)
    return np.asarray(trimesh.sample.sample_surface(solid, count, seed=seed)[0])


def size(points: np.ndarray) -> float:
    """Diagonal of the box about the points."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def pose(rotation: Rotation, shift: np.ndarray) -> np.ndarray:
    """4×4."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), shift
    return T


def random_pose(rng: np.random.Generator, *, upright: bool, reach: float = 3.0) -> np.ndarray:
    """Any rotation, or (`upright`) any turn about the vertical, and a shift of up to `reach` meters an axis."""
    turn = (
        Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)) if upright else Rotation.random(random_state=rng)
    )
    return pose(turn, rng.uniform(-reach, reach, 3))


def apply(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points through a 4×4 pose."""
    return points @ T[:3, :3].T + T[:3, 3]


def pose_error(got: np.ndarray, expected: np.ndarray, points: np.ndarray) -> tuple[float, float]:
    """Degrees between two poses, and meters between where they bring the points' mean."""
    turn = Rotation.from_matrix(got[:3, :3].T @ expected[:3, :3]).magnitude()
    middle = points.mean(axis=0, keepdims=True)
    return float(np.rad2deg(turn)), float(np.linalg.norm(apply(got, middle) - apply(expected, middle)))
