"""Things that do not keep their shape between visits: seats that were turned on their base, cushions, covers, curtains.

A change takes points of an object's first shape to its new one, in the model's frame (meters, standing on z = 0). The
foot stays where it is, so that the object's pose says where it stands.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

TURNED = 0.5  # share of the changes that turn the upper part; the others bend all of it
HIP = (0.3, 0.6)  # height above which it turns, a share of the object's
TURN_DEG = (25.0, 180.0)
JOINT = 0.05  # share of the height over which the turn sets in
BEND_M = (0.02, 0.05)  # root mean square of the displacement of what is bent
WAVES = 3  # displacements along each axis that add up
WAVELENGTH = (0.7, 2.0)  # of the longest edge
FOOT = 0.15  # share of the height over which bending sets in


@dataclass(frozen=True, kw_only=True)
class Turn:
    """The part above a height is turned about the vertical through `center`."""

    center: Float[np.ndarray, " 2"]
    height_m: float
    joint_m: float
    angle: float  # rad

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """The points after the change."""
        share = np.clip((points[:, 2] - self.height_m) / self.joint_m, 0, 1)
        R = Rotation.from_rotvec(self.angle * share[:, None] * [0.0, 0.0, 1.0]).as_matrix()
        center = np.append(self.center, 0.0)
        return np.einsum("nij,nj->ni", R, points - center) + center


@dataclass(frozen=True, kw_only=True)
class Bend:
    """A smooth displacement, which grows from nothing at the floor."""

    waves: Float[np.ndarray, "w 3"]  # wave vectors, rad/m
    phases: Float[np.ndarray, " w"]
    shifts: Float[np.ndarray, "w 3"]  # meters
    foot_m: float

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """The points after the change."""
        share = np.clip(points[:, 2:] / self.foot_m, 0, 1)
        return points + share * (np.sin(points @ self.waves.T + self.phases) @ self.shifts)


ShapeChange = Turn | Bend


def shape_change(vertices: Float[np.ndarray, "v 3"], rng: np.random.Generator) -> ShapeChange:
    """How an object with these vertices changes: half of them are turned at the hip, the others bent."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    height = float(high[2] - low[2])
    if rng.random() < TURNED:
        return Turn(
            center=(low[:2] + high[:2]) / 2,
            height_m=float(low[2] + rng.uniform(*HIP) * height),
            joint_m=JOINT * height,
            angle=float(np.deg2rad(rng.uniform(*TURN_DEG)) * rng.choice([-1, 1])),
        )
    longest = float((high - low).max())
    directions = rng.normal(size=(WAVES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lengths = longest * rng.uniform(*WAVELENGTH, (WAVES, 1))
    shifts = rng.normal(size=(WAVES, 3))
    shifts *= rng.uniform(*BEND_M) * np.sqrt(2) / np.linalg.norm(shifts)  # a sine's square is half on average
    return Bend(
        waves=2 * np.pi * directions / lengths,
        phases=rng.uniform(0, 2 * np.pi, WAVES),
        shifts=shifts,
        foot_m=FOOT * height,
    )
