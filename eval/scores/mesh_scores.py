"""Scores of one mesh against the true one (paper §4), in three columns.

`paper`: the printed formulas, canonical units (longest edge 0.9). `published`: as the published code computes them:
its Chamfer-L1 is squared and against vertices, its IoU the share of true vertices inside. `one_way`: the half of a
Chamfer-L1 that goes from the truth, which may be incomplete, to the mesh (3RScan). `strict`: meters, true IoU, and
distances from samples of one surface to the other surface itself. Between samples of both even equal
surfaces are apart by half the spacing: 0.5 cm of furniture at 20,000 samples.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import point_cloud_utils as pcu
import trimesh
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from eval.data.truth import KnownObject, Pose
from more2_jax.geometry.poses import Points, apply_pose
from more2_jax.types import Mesh

Scores = dict[str, float | None]

NEAR = 0.05  # canonical units: a true point is recalled below it
RECONSTRUCTED = 0.7  # share of true points recalled, from which an object counts
TOLERANCE = 0.01  # of the diagonal, for precision, recall and F
PUBLISHED_SAMPLES = 30_000
RECALL_SAMPLES = 4_000
DISTANCES: tuple[str, ...] = (
    "chamfer.paper",
    "chamfer.published",
    "one_way.paper",
    "one_way.published",
    "chamfer_m.strict",
    "accuracy_m",
    "completeness_m",
    "completeness_diagonal",
)
SHARES: tuple[str, ...] = (
    "f",
    "iou.paper",
    "iou.published",
    "recall.paper",
    "recall.published",
    "recall.strict",
    "watertight",
)


def no_mesh() -> Scores:
    """Scores where there is no surface: nothing recalled, nothing enclosed, no distance."""
    return dict.fromkeys(DISTANCES) | dict.fromkeys(SHARES, 0.0)


def mesh_scores(mesh: Mesh | None, truth: KnownObject, T_frame_model: Pose, samples: int = 100_000) -> Scores:
    """Scores of a mesh given in a frame where the object stands at `T_frame_model`.

    Raises ValueError if the truth has no mesh.
    """
    if truth.mesh is None:
        raise ValueError(f"{truth.name}: the data set has no mesh of it; needed one to score against")
    if mesh is None or not len(mesh.faces):
        return no_mesh()
    true = as_trimesh(truth.mesh)
    found = trimesh.Trimesh(
        apply_pose(np.linalg.inv(T_frame_model), mesh.vertices), mesh.faces, process=False
    )
    points, true_points = surface_points(found, samples), surface_points(true, samples)
    recalled = true_points[:: max(1, len(true_points) // RECALL_SAMPLES)]
    there = to_surface(points, true)
    back, of_recalled, of_vertices = all_to_surface((true_points, recalled, true.vertices), found)
    sampled = [float(KDTree(b).query(a)[0].mean()) for a, b in ((points, true_points), (true_points, points))]
    tolerance = TOLERANCE * float(np.linalg.norm(np.ptp(true.vertices, axis=0)))
    near = NEAR / truth.canonical
    published = _published(found, true, points, truth.canonical)
    published["recall.published"] = sdf_recall(of_vertices, near)
    return {
        **published,
        "chamfer.paper": sum(sampled) / 2 * truth.canonical,
        "one_way.paper": sampled[1] * truth.canonical,
        "chamfer_m.strict": float(there.mean() + back.mean()) / 2,
        "accuracy_m": float(there.mean()),
        "completeness_m": float(back.mean()),
        "completeness_diagonal": float(back.mean()) * TOLERANCE / tolerance,
        "f": f_score(float((there < tolerance).mean()), float((back < tolerance).mean())),
        "iou.paper": joint_iou(found, true, samples),
        "recall.paper": published["recall.published"],  # both of vertices; as tables count them they differ
        "recall.strict": sdf_recall(of_recalled, near),
        "watertight": float(found.is_watertight),
    }


def _published(found: trimesh.Trimesh, true: trimesh.Trimesh, points: Points, canonical: float) -> Scores:
    """Columns that follow the published code."""
    vertices, some = np.asarray(true.vertices), points[:PUBLISHED_SAMPLES]
    there, back = KDTree(vertices).query(some)[0], KDTree(some).query(vertices)[0]
    return {
        "chamfer.published": float((there**2).mean() + (back**2).mean()) * canonical**2,
        "one_way.published": float((back**2).mean()) * canonical**2,
        "iou.published": float(enclosed(found, vertices).mean()),
    }


def as_trimesh(mesh: Mesh) -> trimesh.Trimesh:
    """For measuring; nothing is merged or mended."""
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def surface_points(mesh: trimesh.Trimesh, count: int) -> Points:
    """Points spread over the surface by area, the same every time, in no order."""
    points = np.asarray(trimesh.sample.sample_surface(mesh, count, seed=0)[0])
    return np.random.default_rng(0).permutation(points)


def to_surface(points: Points, mesh: trimesh.Trimesh) -> Float[np.ndarray, " n"]:
    """How far points are from the nearest of a mesh's triangles."""
    points, vertices = (np.array(x, np.float64, order="C") for x in (points, mesh.vertices))
    faces = np.array(mesh.faces, np.int32, order="C")
    return np.abs(pcu.closest_points_on_mesh(points, vertices, faces)[0])


def all_to_surface(clouds: Sequence[Points], mesh: trimesh.Trimesh) -> list[Float[np.ndarray, " _"]]:
    """`to_surface` of several clouds, in one search: its tree of the triangles takes longer than the queries."""
    distance = to_surface(np.concatenate(clouds), mesh)
    return np.split(distance, np.cumsum([len(c) for c in clouds])[:-1])


def sdf_recall(distance: Float[np.ndarray, " n"], threshold: float) -> float:
    """Share of true points closer to the predicted surface than `threshold`, both in one unit."""
    return float(np.mean(distance < threshold))


def f_score(precision: float, recall: float) -> float:
    """Harmonic mean; 0 if both are."""
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


def volume_iou(predicted: Bool[np.ndarray, " q"], truth: Bool[np.ndarray, " q"]) -> float:
    """Intersection over union of two solids, from inside tests at the same points; 0 when both are empty."""
    union = (predicted | truth).sum()
    return float((predicted & truth).sum() / union) if union else 0.0


def joint_iou(found: trimesh.Trimesh, true: trimesh.Trimesh, samples: int) -> float:
    """Intersection over union, from points drawn evenly in the box that holds both."""
    box = np.concatenate([found.bounds, true.bounds])
    points = np.random.default_rng(0).uniform(box.min(axis=0), box.max(axis=0), (samples, 3))
    return volume_iou(enclosed(found, points), enclosed(true, points))


def enclosed(mesh: trimesh.Trimesh, points: Points) -> Bool[np.ndarray, " n"]:
    """Inside tests; of an open surface, where it winds around the point more than half."""
    if mesh.is_watertight:
        return np.asarray(mesh.contains(points), bool)
    faces, vertices = np.asarray(mesh.faces, np.int32), np.asarray(mesh.vertices, np.float64)
    return (
        np.asarray(pcu.triangle_soup_fast_winding_number(vertices, faces, np.ascontiguousarray(points))) > 0.5
    )
