"""Held-out shapes as the prior sees them, drawn without a renderer: cloud, reconstruction, truth side by side."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from more2_jax.config import MeshingConfig
from more2_jax.meshing.extract import extract_mesh
from more2_jax.network.embedding_batch import embed
from more2_jax.network.prior import Prior, points_read
from more2_jax.types import Mesh
from train.run.settings import TrainingConfig
from train.shards.sampling import sample_batch
from train.shards.shards import Shapes

PIXELS = 128
HALF = 0.62  # of the picture's width, canonical units
MESHING = MeshingConfig(coarse_resolution=16, resolution=32)
ON_SURFACE = 12_000  # points drawn of a mesh
LIGHT = np.array([0.35, -0.55, 0.76])
# The picture's axes: to the right, up, and toward the eye, which looks down from the front left.
EYE = np.array([[0.83, 0.55, 0.0], [-0.23, 0.35, 0.91], [0.50, -0.76, 0.42]])


def held_out(prior: Prior, shapes: Shapes, config: TrainingConfig, count: int) -> UInt8[np.ndarray, "h w 3"]:
    """A row a shape: what was seen of it (three views at most), the mesh from its code, the whole surface.

    Takes `count` shapes spread evenly; the same at every call.
    """
    index = jnp.asarray(np.linspace(0, len(shapes.views) - 1, min(count, len(shapes.views))).astype(int))
    clean = dataclasses.replace(config, max_views=3, augment_probability=0.0, normals_unknown_probability=0.0)
    sample = sample_batch(jax.random.key(2), shapes, index, clean, points_read(prior.config))
    views = [np.asarray(x[:, 0]) for x in (sample.points, sample.normals, sample.mask)]
    clouds, normals = ([x[i][m] for i, m in enumerate(views[2])] for x in views[:2])
    embeddings = embed(prior, clouds, normals if prior.config.decoder.normals else None)
    rows = []
    for shape, seen, embedding in zip(index, clouds, embeddings, strict=True):
        mesh = extract_mesh(prior, embedding, MESHING)
        whole = np.asarray(shapes.views[shape], np.float64).reshape(-1, 3)
        rows.append(np.hstack([splat(seen, None, 2), _surface(mesh), splat(whole, None, 1)]))
    return np.vstack(rows)


def _surface(mesh: Mesh | None) -> UInt8[np.ndarray, "h w 3"]:
    """The mesh by points of its faces; a blank tile where there is none."""
    if mesh is None:
        return np.full((PIXELS, PIXELS, 3), 255, np.uint8)
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    rng = np.random.default_rng(0)
    face = rng.choice(len(area), ON_SURFACE, p=area / area.sum())
    weight = rng.dirichlet(np.ones(3), ON_SURFACE)
    points = np.einsum("nk,nkx->nx", weight, corners[face])
    return splat(points, normal[face] / np.maximum(area[face], 1e-12)[:, None], 1)


def splat(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"] | None, radius: int
) -> UInt8[np.ndarray, "h w 3"]:
    """Points as squares of 2·radius + 1 pixels, the nearest on top; shaded by normal, or else by depth."""
    right, up, depth = EYE @ points.T
    spread = np.arange(-radius, radius + 1)
    column = np.round((right / HALF + 1) * PIXELS / 2).astype(int)[:, None, None] + spread[None, :, None]
    row = np.round((1 - up / HALF) * PIXELS / 2).astype(int)[:, None, None] + spread[None, None, :]
    if normals is None:
        shade = np.clip(0.55 + 0.45 * depth / HALF, 0, 1)
    else:
        shade = np.clip(0.35 + 0.65 * np.clip(normals @ LIGHT, 0, 1), 0, 1)
    color = np.array([70, 110, 160]) + shade[:, None] * np.array([150, 110, 60])
    # Far to near: later writes win.
    order = np.argsort(depth)
    row, column = np.broadcast_arrays(row, column)
    inside = ((row >= 0) & (row < PIXELS) & (column >= 0) & (column < PIXELS))[order]
    owner = np.broadcast_to(np.arange(len(points))[:, None, None], row.shape)[order][inside]
    image = np.full((PIXELS, PIXELS, 3), 255, np.uint8)
    image[row[order][inside], column[order][inside]] = color[owner].astype(np.uint8)
    return image
