"""Which rotations leave an object looking the same: measured once, from its mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from more2_jax.geometry.poses import Pose

TOLERANCE = 0.015  # of the diagonal: what the turned surface may lie off the unturned one,
SAME = 0.9  # in so large a share of it
SAMPLES, QUERIES, PARTS = 40_000, 3_000, 20
ODD_TURNS_DEG = (120.0, 240.0, 72.0, 144.0, 216.0, 288.0, 60.0, 300.0, 45.0, 135.0, 225.0, 315.0)
ANY_TURN_DEG = (23.0, 51.0, 77.0)  # in no small group: a body that passes all is one of revolution


@dataclass(frozen=True, kw_only=True)
class SymmetryGroup:
    """Rotations about `center` (model frame) that map the object onto itself; the identity is one of them.

    With `revolution`, each of them may be followed by any turn about the model's vertical.
    """

    rotations: Float[np.ndarray, "k 3 3"]
    center: Float[np.ndarray, "3"]
    revolution: bool = False

    @classmethod
    def trivial(cls) -> SymmetryGroup:
        """No symmetry at all."""
        return cls(rotations=np.eye(3)[None], center=np.zeros(3))

    @classmethod
    def turns(cls, order: int, center: Float[np.ndarray, "3"]) -> SymmetryGroup:
        """`order` equal turns about the vertical through `center`. Raises ValueError below 1."""
        if order < 1:
            raise ValueError(f"symmetry of {order} turns; needed 1 or more")
        angles_deg = tuple(360.0 * k / order for k in range(order))
        return cls(rotations=_turns(angles_deg), center=np.asarray(center, float))

    def placements(self, R_model: Float[np.ndarray, "3 3"]) -> list[Pose]:
        """The group's elements as poses in the model frame; of a revolution, the turns nearest to `R_model`."""
        return [self._about_center(self._spun(g, R_model) if self.revolution else g) for g in self.rotations]

    def _about_center(self, R: Float[np.ndarray, "3 3"]) -> Pose:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, self.center - R @ self.center
        return T

    @staticmethod
    def _spun(g: Float[np.ndarray, "3 3"], R_model: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
        """Rz(θ) g with the θ for which it is nearest to `R_model`: the maximum of tr(R_modelᵀ Rz(θ) g)."""
        B = g @ R_model.T
        angle = np.arctan2(B[0, 1] - B[1, 0], B[0, 0] + B[1, 1])
        return Rotation.from_euler("z", angle).as_matrix() @ g


def measure(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> SymmetryGroup:
    """The symmetry group of a mesh whose z is up, among a cube's 24 rotations, a few more turns, and revolution."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    points = np.asarray(trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)[0])
    center, diagonal = points.mean(axis=0), float(np.linalg.norm(np.ptp(points, axis=0)))
    tree, some = KDTree(points - center), (points - center)[:QUERIES]

    def same(R: np.ndarray) -> bool:
        missed = 0
        for part in np.array_split(some @ R.T, PARTS):
            near = tree.query(part, distance_upper_bound=TOLERANCE * diagonal)[0]
            missed += np.isinf(near).sum()
            if (len(some) - missed) / len(
                some
            ) < SAME:  # most turns are seen not to fit by their first points
                return False
        return True

    kept = [R for R in candidates() if same(R)]
    revolution = all(same(R) for R in _turns(ANY_TURN_DEG))
    return SymmetryGroup(rotations=np.stack(kept), center=center, revolution=revolution)


def candidates() -> Float[np.ndarray, "k 3 3"]:
    """The identity first, then the other rotations of a cube, then turns about the vertical that it has not."""
    cube = Rotation.create_group("O").as_matrix()
    order = np.argsort([-np.trace(R) for R in cube], kind="stable")
    return np.concatenate([np.round(cube[order]), _turns(ODD_TURNS_DEG)])


def _turns(angles_deg: tuple[float, ...]) -> Float[np.ndarray, "k 3 3"]:
    return Rotation.from_euler("z", np.array(angles_deg)[:, None], degrees=True).as_matrix()


def equivalent_poses(T: Pose, T_ref_model: Pose, T_scan_model: Pose, symmetry: SymmetryGroup) -> list[Pose]:
    """Every `T_ref_scan` that is as true as the one that was annotated; of a revolution, those nearest to `T`."""
    in_model = T_ref_model[:3, :3].T @ T[:3, :3] @ T_scan_model[:3, :3]
    back = np.linalg.inv(T_scan_model)
    return [T_ref_model @ S @ back for S in symmetry.placements(in_model)]


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
