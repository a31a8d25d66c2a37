"""Shapes whose distance is known in closed form."""

import numpy as np
import trimesh


def sphere(radius: float, subdivisions: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a sphere about the origin."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return np.asarray(ball.vertices), np.asarray(ball.faces)


def box_distance(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Signed distance of a box about the origin, of half edges `half`; negative inside."""
    beyond = np.abs(points) - half
    return np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)
