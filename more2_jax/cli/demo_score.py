"""How well the demo went: every object of the room against the ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float
from rich.table import Table

from more2_jax.geometry.poses import Pose, apply_pose
from more2_jax.metrics import chamfer_l1, symmetry_aware_rotation_error_deg
from more2_jax.scans.demo import DemoTruth, TrueInstance, demo_ground_truth
from more2_jax.tracking.objects import reference_pose
from more2_jax.types import LivingScene, SceneObject

RIGHT_DEG = 5.0  # a pose is right below this, up to the object's own symmetry
VERTICAL = np.array([0.0, 0, 1])


@dataclass(frozen=True, kw_only=True)
class DemoScore:
    """One object of the living scene against the truth."""

    name: str
    model: str
    matched: bool  # every observation is of the same object, or of its identical copy
    complete: bool  # it was found in every scan in which it stood
    rotation_error_deg: float  # worst over observations; NaN when seen once
    translation_error_m: float
    chamfer_m: float  # mesh against the true surface, (accuracy + completeness) / 2; NaN without mesh

    @property
    def right(self) -> bool:
        """Found everywhere, matched to itself, and posed to within `RIGHT_DEG`."""
        return self.matched and self.complete and not self.rotation_error_deg > RIGHT_DEG


def score_demo(scene: LivingScene, truth: DemoTruth) -> list[DemoScore]:
    """Scores every object of the living scene made of the demo scans."""
    return [score_object(o, truth) for o in scene.objects]


def score_object(o: SceneObject, truth: DemoTruth) -> DemoScore:
    """One object against the truth; identical copies may stand in for each other."""
    reference, seen = o.observations[0], o.observations[1:]
    mine = truth.at(reference.scan, reference.instance)
    others = [truth.at(s.scan, s.instance) for s in seen]
    T_scan_ref = np.linalg.inv(reference.T_ref_scan)
    errors = [
        pose_error(mine, other, T_scan_ref @ s.T_ref_scan, truth)
        for s, other in zip(seen, others, strict=True)
        if other.model == mine.model
    ]
    stood = {one.scan for one in truth.instances if one.object == mine.object and one.scan >= reference.scan}
    return DemoScore(
        name=mine.object,
        model=mine.model,
        matched=all(other.model == mine.model for other in others),
        complete=stood == {s.scan for s in o.observations},
        rotation_error_deg=max((e[0] for e in errors), default=float("nan")),
        translation_error_m=max((e[1] for e in errors), default=float("nan")),
        chamfer_m=mesh_error(o, mine, truth),
    )


def pose_error(
    reference: TrueInstance, other: TrueInstance, T_reference_other: Pose, truth: DemoTruth
) -> tuple[float, float]:
    """Rotation error (degrees, up to the model's symmetry) and error in placing its center (meters), between scans."""
    T_true = reference.T_scan_model @ np.linalg.inv(other.T_scan_model)
    # In the reference scan's frame the symmetry axis is the model's vertical, turned along.
    rotation_deg = symmetry_aware_rotation_error_deg(
        T_reference_other[:3, :3],
        T_true[:3, :3],
        axis=other.T_scan_model[:3, :3] @ VERTICAL,
        order=truth.symmetry_order[reference.model],
    )
    center = apply_pose(other.T_scan_model, truth.surfaces[reference.model].mean(axis=0, keepdims=True))
    distance = np.linalg.norm(apply_pose(T_reference_other, center) - apply_pose(T_true, center))
    return float(rotation_deg), float(distance)


def mesh_error(o: SceneObject, mine: TrueInstance, truth: DemoTruth) -> float:
    """Chamfer-L1 of the mesh against the true outer surface, meters."""
    if o.mesh is None:
        return float("nan")
    mesh = trimesh.Trimesh(o.mesh.vertices, o.mesh.faces, process=False)
    points = trimesh.sample.sample_surface(mesh, 10_000, seed=0)[0]
    surface: Float[np.ndarray, "n 3"] = apply_pose(
        reference_pose(o) @ mine.T_scan_model, truth.surfaces[mine.model]
    )
    return float(chamfer_l1(np.asarray(points), surface))


def persisting(truth: DemoTruth) -> set[str]:
    """Objects that stand in every scan."""
    scans = {one.scan for one in truth.instances}
    return {
        name
        for name in {one.object for one in truth.instances}
        if {one.scan for one in truth.instances if one.object == name} == scans
    }


def demo_table(scene: LivingScene) -> tuple[Table, str]:
    """The table that ends `more2 demo`, and its summary in one line."""
    truth = demo_ground_truth()
    scores = score_demo(scene, truth)
    table = Table("object", "truth", "matched", "rotation error", "position error", "mesh chamfer")
    for o, s in zip(scene.objects, scores, strict=True):
        table.add_row(
            o.id,
            f"{s.name} ({truth.names[s.model]})",
            "yes" if s.matched and s.complete else "incomplete" if s.matched else "no",
            "–" if np.isnan(s.rotation_error_deg) else f"{s.rotation_error_deg:.1f}°",
            "–" if np.isnan(s.translation_error_m) else f"{100 * s.translation_error_m:.1f} cm",
            "–" if np.isnan(s.chamfer_m) else f"{100 * s.chamfer_m:.1f} cm",
        )
    stay = persisting(truth)
    right = {s.name for s in scores if s.right and s.name in stay}
    return (
        table,
        f"{len(right)} of {len(stay)} persisting objects right (matched in every scan, pose < {RIGHT_DEG:g}°)",
    )
