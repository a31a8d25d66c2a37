"""What goes into the page: numbers and words as JSON, points and meshes as one blob."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from more2_jax.config import SceneConfig
from more2_jax.geometry.poses import apply_pose
from more2_jax.report.blob import Blob
from more2_jax.report.coverage import coverage
from more2_jax.report.details import DETAILS, detail_of, is_large
from more2_jax.report.palette import color, ink
from more2_jax.report.shape import Point, anchor_of, cloud_in, index_type, is_closed, surface_in
from more2_jax.report.thinning import (
    MAX_COARSE_FACES,
    MAX_FACES,
    MAX_POINTS,
    MAX_POINTS_WITH_DETAILS,
    cluster_vertices,
    coarse_faces,
    kept_share,
    random_subsample,
)
from more2_jax.report.wording import Verdict, changes_from, doubts_of, headline, phrase, verdict
from more2_jax.tracking.objects import number_of, place_of
from more2_jax.types import LivingScene, Mesh, Observation, ScanRecord, SceneObject


def pairs_of(scene: LivingScene) -> list[tuple[int, int]]:
    """The pairs of scans the page compares: each with the one before, with the first, and the first alone."""
    last = len(scene.scans)
    return [(0, 0), *sorted({(a, b) for b in range(1, last) for a in (b - 1, 0)})]


def verdicts_of(scene: LivingScene, config: SceneConfig) -> dict[tuple[int, int], list[Verdict]]:
    """What became of every object, for every pair of `pairs_of`."""
    changes = {pair: changes_from(scene, *pair, config) for pair in pairs_of(scene)}
    return {pair: [verdict(o, c) for o in scene.objects] for pair, c in changes.items()}


def payload(scene: LivingScene, config: SceneConfig) -> tuple[dict[str, Any], str]:
    """The page's data: what goes in as JSON, and the text of its `Blob`.

    Everything lies relative to the scene's middle, so that 32 bit floats of a graphics card are enough
    kilometers away from the frame's zero. Lengths are meters, rotations quaternions (x, y, z, w).
    """
    blob = Blob()
    objects = _reach(
        apply_pose(place_of(seen), o.points[o.point_scan == seen.scan])
        for o in scene.objects
        for seen in o.observations
    )
    around = _reach(_background(s) for s in scene.scans)
    low, high = np.minimum(objects.low, around.low), np.maximum(objects.high, around.high)
    middle = (low + high) / 2
    large = is_large(scene)
    points = kept_share(objects.count + around.count, MAX_POINTS_WITH_DETAILS if large else MAX_POINTS)
    faces = kept_share(sum(len(o.mesh.faces) for o in scene.objects if o.mesh is not None), MAX_FACES)
    coarse = MAX_COARSE_FACES // len(scene.objects)
    data = {
        "scans": [_scan(s, blob, points, middle) for s in scene.scans],
        "objects": [
            _object(o, blob, points, faces, coarse, middle) | ({"detail": detail_of(o)} if large else {})
            for o in scene.objects
        ],
        "pairs": {f"{a}-{b}": _pair(scene, v, a, b) for (a, b), v in verdicts_of(scene, config).items()},
        "size": (high - low).tolist(),
        "box": {"low": (objects.low - middle).tolist(), "high": (objects.high - middle).tolist()},
        "share": {"points": points, "faces": faces},
    }
    return data | ({"details": DETAILS} if large else {}), blob.text()


class _Reach(NamedTuple):
    """The box of clouds, and how many points they have."""

    low: Point
    high: Point
    count: int


def _reach(clouds: Iterable[Float[np.ndarray, "n 3"]]) -> _Reach:
    """Of clouds taken one at a time, for all of a building at once would fill the memory; of none, nothing."""
    low, high, count = np.full(3, np.inf), np.full(3, -np.inf), 0
    for cloud in clouds:
        low = np.minimum(low, cloud.min(axis=0, initial=np.inf))
        high = np.maximum(high, cloud.max(axis=0, initial=-np.inf))
        count += len(cloud)
    return _Reach(low, high, count)


def _pair(scene: LivingScene, verdicts: list[Verdict], a: int, b: int) -> dict[str, Any]:
    return {
        "headline": headline(scene, verdicts, a, b),
        "verdicts": [
            {
                "status": v.status,
                "text": phrase(v),
                "doubts": list(v.doubts),
                "distance_m": v.distance_m,
                "angle_deg": v.angle_deg,
            }
            for v in verdicts
        ],
    }


def _scan(s: ScanRecord, blob: Blob, share: float, middle: Point) -> dict[str, Any]:
    has = len(s.background) > 0
    background = blob.add_points(random_subsample(_background(s) - middle, share)) if has else None
    return {"name": s.name, "background": background}


def _background(s: ScanRecord) -> Float[np.ndarray, "b 3"]:
    """What is no object, in the scene's frame."""
    return apply_pose(s.frame.T_scene_scan, s.background)


def _object(
    o: SceneObject, blob: Blob, points: float, faces: float, coarse: int, middle: Point
) -> dict[str, Any]:
    """One object; its cloud and mesh relative to `anchor`, the mean of its points in the reference frame."""
    anchor = anchor_of(o)
    mesh = None if o.mesh is None else cluster_vertices(o.mesh, faces)
    return {
        "id": o.id,
        "number": number_of(o),
        "name": name_of(o),
        "color": color(number_of(o)),
        "ink": ink(number_of(o)),
        "coverage": None if o.mesh is None else coverage(o.mesh, o.points),
        "observations": [_observation(o, seen, anchor, middle) for seen in o.observations],
        **cloud_in(blob, o, points),
        "mesh": None if mesh is None else _mesh(mesh, blob, anchor, coarse),
    }


def _mesh(mesh: Mesh, blob: Blob, anchor: Point, most: int) -> dict[str, Any]:
    """A surface, and a version of it with about `most` faces, on the same vertices, to be drawn while things move."""
    return {
        **surface_in(blob, mesh, anchor),
        "coarse": blob.add(coarse_faces(mesh, most).reshape(-1).astype(index_type(mesh))),
        "closed": is_closed(mesh),
    }


def _observation(o: SceneObject, seen: Observation, anchor: Point, middle: Point) -> dict[str, Any]:
    """Where the object lies in one scan, in the scene's frame, and how sure that is."""
    T_scene_ref = place_of(seen)
    mine = o.point_scan == seen.scan
    reference = seen.scan == o.reference_scan
    return {
        "scan": seen.scan,
        "position": (apply_pose(T_scene_ref, anchor[None])[0] - middle).tolist(),
        "quaternion": Rotation.from_matrix(T_scene_ref[:3, :3]).as_quat().tolist(),
        "score": None if reference else seen.score,
        "rms_mm": None if reference else 1000 * seen.rms_m,
        "doubts": doubts_of(o, seen),
        "points": int(mine.sum()),
        "coverage": None if o.mesh is None else coverage(o.mesh, o.points[mine]),
    }


def name_of(o: SceneObject) -> str:
    """What a person calls it: its label, else `object 3`."""
    return o.label or f"object {number_of(o)}"
