"""Cloud and surface of one object in a `Blob`, relative to its anchor: the page holds them coarse, details fine."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float

from more2_jax.report.blob import Blob
from more2_jax.report.thinning import random_subsample
from more2_jax.types import Mesh, SceneObject

Point = Float[np.ndarray, "3"]


def anchor_of(o: SceneObject) -> Point:
    """The mean of the object's points in its reference frame, meters."""
    return o.points.mean(axis=0)


def cloud_in(blob: Blob, o: SceneObject, share: float) -> dict[str, Any]:
    """A share of each observation's points, one observation after the other, and how many each has."""
    parts = [random_subsample(o.points[o.point_scan == seen.scan], share) for seen in o.observations]
    cloud = blob.add_points(np.concatenate(parts) - anchor_of(o))
    return {"cloud": cloud, "counts": [len(p) for p in parts]}


def surface_in(blob: Blob, mesh: Mesh, anchor: Point) -> dict[str, Any]:
    """All vertices and faces of a mesh."""
    vertices = blob.add_points(mesh.vertices - anchor)
    return {"vertices": vertices, "faces": blob.add(mesh.faces.reshape(-1).astype(index_type(mesh)))}


def index_type(mesh: Mesh) -> type[np.unsignedinteger]:
    """The smallest type of `Blob` that counts the vertices."""
    return np.uint16 if len(mesh.vertices) <= 65536 else np.uint32


def is_closed(mesh: Mesh) -> bool:
    """Whether nobody sees the surface from within."""
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    return bool(solid.is_watertight and solid.volume > 0)
