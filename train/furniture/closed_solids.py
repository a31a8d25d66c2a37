"""Closed solids from the polygon soups that furniture comes as: what signed distances and insides need.

Soups made of closed parts are united exactly. Any other soup is wrapped by an octree's outer surface, which is
then drawn onto the soup, `SHELL` outside it: so a sheet without thickness keeps an inside.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import manifold3d
import numpy as np
import point_cloud_utils as pcu
import trimesh
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

RESOLUTION = 20_000  # octree cells of a wrapping: 0.5 to 4 s, its surface 0.002 to 0.013 outside the soup
SHELL = 0.003  # how far outside the soup a wrapped solid ends, canonical units
SIMPLIFY = 0.001  # how far a simplified surface may lie off, canonical units
CLOSED_SHARE = 0.999  # of the area, in closed parts: such a soup is united, not wrapped
FLATTEST = 0.004  # shortest edge of the bounding box, canonical units
# Axis-aligned boards meet the octree's cells edge to edge, which makes wrapping slow: turned, they do not.
TURN = Rotation.from_euler("xyz", [0.35, 0.6, 0.9]).as_matrix()


@dataclass(frozen=True, kw_only=True)
class Solid:
    """A closed surface, wound outward; the unit is the caller's."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    method: Literal["united", "wrapped"]


def canonical(vertices: Float[np.ndarray, "v 3"]) -> tuple[Float[np.ndarray, "v 3"], float]:
    """Bounding box centered at the origin, longest edge 0.9; and source units per canonical unit.

    Raises ValueError as `canonical_frame`.
    """
    center, scale = canonical_frame(vertices)
    return (vertices - center) / scale, scale


def canonical_frame(vertices: Float[np.ndarray, "v 3"]) -> tuple[Float[np.ndarray, " 3"], float]:
    """Center of the bounding box, and source units per canonical unit.

    Raises ValueError if there are no vertices, or their extent is zero or not finite.
    """
    if not len(vertices):
        raise ValueError("no vertices; needed a shape with some")
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    scale = float((high - low).max()) / 0.9
    if not np.isfinite(scale) or scale <= 0:
        raise ValueError(f"extent {high - low}; needed a shape with some")
    return (low + high) / 2, scale


def watertight(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """The closed solid of a soup, in the soup's frame and unit. Raises ValueError, see `solidify`."""
    solid = solidify(vertices, faces)
    return solid.vertices, solid.faces


def solidify(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Solid:
    """The closed solid of a soup, in the soup's frame and unit.

    Closed parts wound inside out are turned. Raises ValueError if the soup has no surface or is flat, or if no
    closed solid comes of it.
    """
    unit, scale = canonical(vertices)
    if not len(faces):
        raise ValueError("0 faces; needed a surface")
    if (thinnest := float(np.ptp(unit, axis=0).min())) < FLATTEST:
        raise ValueError(f"flat: {thinnest:.4f} thick; needed {FLATTEST} of a length of 0.9")
    parts = closed_parts(unit, faces)
    body, method = (unite(parts), "united") if parts else (wrap(unit, faces), "wrapped")
    mesh = body.simplify(SIMPLIFY).to_mesh()
    if body.is_empty() or not len(mesh.tri_verts) or body.volume() <= 0:
        raise ValueError(f"not closable: {method}, the solid is empty or inside out")
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return Solid(
        vertices=np.ascontiguousarray(mesh.vert_properties[:, :3], np.float64) * scale + (low + high) / 2,
        faces=np.ascontiguousarray(mesh.tri_verts, np.int64),
        method=method,
    )


def closed_parts(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> list[trimesh.Trimesh] | None:
    """The parts of a soup, wound outward, if all of its area is in closed ones; else None."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=6)
    mesh.update_faces(mesh.nondegenerate_faces())
    parts = [p for p in mesh.split(only_watertight=False, repair=False) if p.area > 1e-9]
    closed = [p for p in parts if p.is_watertight and p.is_winding_consistent]
    if sum(p.area for p in closed) < CLOSED_SHARE * mesh.area or mesh.area <= 0:
        return None
    for part in closed:
        if part.volume < 0:
            part.invert()
    return closed


def unite(parts: list[trimesh.Trimesh]) -> manifold3d.Manifold:
    """The union of closed parts. Raises ValueError where one is no manifold."""
    solids = [manifold(np.asarray(p.vertices), np.asarray(p.faces)) for p in parts]
    return manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)


def wrap(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> manifold3d.Manifold:
    """The outer surface of a soup, `SHELL` outside it; canonical units. Raises ValueError if it is not closed."""
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    soup = np.ascontiguousarray(faces[area > 1e-9], np.int32)  # a triangle without area has no nearest point
    if not len(soup):
        raise ValueError("no face with an area; needed a surface")
    vertices = np.ascontiguousarray(vertices, np.float64)
    outer, outer_faces = pcu.make_mesh_watertight(
        np.ascontiguousarray(vertices @ TURN.T), soup, resolution=RESOLUTION
    )
    outer = np.ascontiguousarray(outer @ TURN)
    _, face, weights = pcu.closest_points_on_mesh(outer, vertices, soup)
    on_soup = pcu.interpolate_barycentric_coords(soup, face, weights, vertices)
    away = outer - on_soup
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    return manifold(on_soup + SHELL * away, outer_faces)


def manifold(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> manifold3d.Manifold:
    """The mesh as a manifold. Raises ValueError if it is none."""
    body = manifold3d.Manifold(
        manifold3d.Mesh(
            vert_properties=np.ascontiguousarray(vertices, np.float32),
            tri_verts=np.ascontiguousarray(faces, np.uint32),
        )
    )
    if body.status() != manifold3d.Error.NoError:
        raise ValueError(f"not closable: {body.status().name}; needed a closed surface")
    return body
