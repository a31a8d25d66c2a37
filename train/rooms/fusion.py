"""Depth frames fused into one colored mesh: truncated signed distances (Curless & Levoy 1996), then decimation.

Frames are fused where the device believes to be, so its drift is in the mesh.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import point_cloud_utils as pcu
import trimesh
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from more2_jax.geometry.poses import Pose
from train.rooms.depth_sensor import DepthSensor

TRUNCATION_VOXELS = 3
LEAST_WEIGHT = 2.0  # frames that a voxel must be seen in
SMALLEST_PIECE = 60  # vertices: smaller pieces are dropped, as scanners do


@dataclass(frozen=True, kw_only=True)
class ColoredMesh:
    """A scan as a mesh; colors are shares of red, green and blue."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    colors: Float[np.ndarray, "v 3"]

    @property
    def normals(self) -> Float[np.ndarray, "v 3"]:
        """Unit normals of the vertices, toward the free space."""
        return np.array(trimesh.Trimesh(self.vertices, self.faces, process=False).vertex_normals)


class Volume:
    """A truncated signed distance over a box, voxel by voxel; positive in front of surfaces."""

    def __init__(self, low: Float[np.ndarray, " 3"], high: Float[np.ndarray, " 3"], voxel_m: float) -> None:
        self.low, self.voxel_m = low, voxel_m
        self.shape: tuple[int, int, int] = tuple(np.ceil((high - low) / voxel_m).astype(int) + 1)
        count = int(np.prod(self.shape))
        self.distance, self.weight = np.ones(count, np.float32), np.zeros(count, np.float32)
        self.color = np.zeros((count, 3), np.float32)
        self.touched = np.zeros(count, bool)

    def add(
        self,
        measured: Float[np.ndarray, " p"],
        colors: Float[np.ndarray, "p 3"],
        T_room_camera: Pose,
        sensor: DepthSensor,
    ) -> None:
        """Fuses one frame: depths along z in meters, 0 for none, and colors, row by row."""
        band = TRUNCATION_VOXELS * self.voxel_m
        flat = self._near(measured, T_room_camera, sensor, band)
        cell = np.stack(np.unravel_index(flat, self.shape), axis=-1)
        centers = self.low + cell * self.voxel_m
        local = (centers - T_room_camera[:3, 3]) @ T_room_camera[:3, :3]
        pixel, inside = sensor.pixel(local)
        ahead = measured[pixel] - local[:, 2]
        kept = inside & (measured[pixel] > 0) & (ahead > -band)
        flat, pixel, ahead = flat[kept], pixel[kept], ahead[kept]
        value = np.minimum(1.0, ahead / band).astype(np.float32)
        old = self.weight[flat]
        self.distance[flat] = (self.distance[flat] * old + value) / (old + 1)
        self.color[flat] = (self.color[flat] * old[:, None] + colors[pixel]) / (old + 1)[:, None]
        self.weight[flat] = old + 1

    def _near(
        self, measured: np.ndarray, T_room_camera: Pose, sensor: DepthSensor, band: float
    ) -> Int[np.ndarray, " n"]:
        """Voxels within the band about what a frame measures, each once."""
        hit = np.flatnonzero(measured > 0)
        rays = sensor.rays[hit] @ T_room_camera[:3, :3].T
        for shift in np.arange(-band, band + self.voxel_m / 2, self.voxel_m):
            places = T_room_camera[:3, 3] + rays * (measured[hit] + shift)[:, None]
            cell = np.round((places - self.low) / self.voxel_m).astype(np.int64)
            cell = cell[((cell >= 0) & (cell < self.shape)).all(axis=1)]
            self.touched[np.ravel_multi_index(tuple(cell.T), self.shape)] = True
        flat = np.flatnonzero(self.touched)
        self.touched[flat] = False
        return flat

    def mesh(self) -> ColoredMesh:
        """The zero surface where every corner of a cell was seen. ValueError if there is none."""
        known = (self.weight >= LEAST_WEIGHT).reshape(self.shape)
        whole = np.zeros(self.shape, bool)  # marching cubes asks at a cell's farthest corner
        whole[1:, 1:, 1:] = True
        for corner in np.ndindex(2, 2, 2):
            part = tuple(slice(c, n - 1 + c) for c, n in zip(corner, self.shape, strict=True))
            whole[1:, 1:, 1:] &= known[part]
        volume = self.distance.reshape(self.shape)
        vertices, faces, _, _ = marching_cubes(volume, 0.0, mask=whole, gradient_direction="descent")
        cell = np.clip(np.round(vertices).astype(np.int64), 0, np.array(self.shape) - 1)
        colors = self.color[np.ravel_multi_index(tuple(cell.T), self.shape)]
        return ColoredMesh(
            vertices=self.low + vertices.astype(np.float64) * self.voxel_m,
            faces=faces.astype(np.int64),
            colors=colors.astype(np.float64),
        )


def fuse(
    frames: Iterable[tuple[np.ndarray, np.ndarray, Pose]],
    sensor: DepthSensor,
    box: tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]],
    voxel_m: float,
    kept_faces: float,
) -> ColoredMesh:
    """The mesh of frames (depths, colors, believed T_room_camera) within a box; `kept_faces` is the share that
    decimation leaves. Raises ValueError if nothing was seen twice."""
    volume = Volume(*box, voxel_m)
    for measured, colors, T_room_camera in frames:
        volume.add(measured, colors, T_room_camera, sensor)
    return decimated(without_crumbs(volume.mesh()), kept_faces)


def without_bow_ties(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "g 3"]:
    """The faces less those at vertices where two borders meet, which no edge collapse can handle."""
    size = int(faces.max(initial=0)) + 1
    while True:
        pairs = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        edges, count = np.unique(pairs[:, 0] * size + pairs[:, 1], return_counts=True)
        ends = np.stack(np.divmod(edges[count == 1], size))
        borders = np.bincount(ends.ravel(), minlength=size)
        bad = (borders > 2)[faces].any(axis=1)
        if not bad.any():
            return faces
        faces = faces[~bad]


def without_crumbs(mesh: ColoredMesh) -> ColoredMesh:
    """The mesh without pieces of fewer than `SMALLEST_PIECE` vertices, and without bow ties."""
    count, faces = len(mesh.vertices), without_bow_ties(mesh.faces)
    edges = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    links = coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
    piece = connected_components(links, directed=False)[1]
    kept = np.bincount(piece)[piece] >= SMALLEST_PIECE
    number = np.cumsum(kept) - 1
    return ColoredMesh(
        vertices=mesh.vertices[kept], faces=number[faces[kept[faces[:, 0]]]], colors=mesh.colors[kept]
    )


def decimated(mesh: ColoredMesh, kept_faces: float) -> ColoredMesh:
    """Edges collapsed until `kept_faces` (a share) of the faces are left; vertices keep their colors."""
    if kept_faces >= 1:
        return mesh
    vertices, faces, origin, _ = pcu.decimate_triangle_mesh(
        mesh.vertices, mesh.faces, int(kept_faces * len(mesh.faces))
    )
    return ColoredMesh(vertices=vertices, faces=faces.astype(np.int64), colors=mesh.colors[origin])
