"""Pictures of prepared data: `python -m eval.data_pictures --shards data/real … --out docs/pictures`.

A contact sheet of shapes, the depth views of a few, and slices through their signed distances.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.ray.ray_pyembree import RayMeshIntersector

from train.furniture.source_mesh import SourceMesh
from train.run.program import run
from train.shards.shards import open_shards, read_meta, read_solids, shard_folders
from train.shards.signed_distance import BOX, is_inside
from train.shards.view_directions import view_directions

EYE = np.array([1.1, -1.5, 0.8])
PIXELS = 110
ROWS, COLUMNS = 8, 12


def main(shards: tuple[Path, ...], out: Path = Path("docs/pictures"), seed: int = 0) -> None:
    """Draws shapes.png, views.png and slices.png.

    Args:
        shards: folders that `train.prepare` wrote.
        out: folder for the pictures.
        seed: of the choice of shapes.
    """
    solids = [s for folder in shards for shard in shard_folders(folder) for s in _trained_on(shard)]
    if not solids:
        raise ValueError("no shapes in these folders; needed some")
    rng = np.random.default_rng(seed)
    out.mkdir(parents=True, exist_ok=True)
    chosen = spread(solids, ROWS * COLUMNS, rng)
    save(
        np.vstack([np.hstack([shaded(s) for s in row]) for row in batches(chosen, COLUMNS)]),
        out / "shapes.png",
    )
    few = spread(solids, 4, rng)
    save(np.hstack([seen_points(shards, s) for s in few]), out / "views.png")
    save(np.vstack([np.hstack([shaded(s, 180), *slices(s)]) for s in few]), out / "slices.png")


def _trained_on(shard: Path) -> list[SourceMesh]:
    train = {m["name"] for m in read_meta(shard) if m["split"] != "test"}
    return [s for s in read_solids(shard) if s.name in train]


def spread(solids: Sequence[SourceMesh], count: int, rng: np.random.Generator) -> list[SourceMesh]:
    """`count` solids, the categories in turn, sorted by category."""
    shuffled = [solids[k] for k in rng.permutation(len(solids))]
    turn: dict[str, int] = {}
    ranked = []
    for s in shuffled:
        turn[s.category] = turn.get(s.category, 0) + 1
        ranked.append((turn[s.category], s))
    first = [s for _, s in sorted(ranked, key=lambda r: r[0])[:count]]
    return sorted(first, key=lambda s: s.category)


def batches(items: Sequence[SourceMesh], size: int) -> list[Sequence[SourceMesh]]:
    """Whole rows of `size`."""
    return [items[k : k + size] for k in range(0, len(items) - size + 1, size)]


def shaded(solid: SourceMesh, pixels: int = PIXELS) -> Float[np.ndarray, "h w 3"]:
    """A picture of the solid, lit from the eye's upper left."""
    mesh = trimesh.Trimesh(solid.vertices, solid.faces, process=False)
    eye, rays = camera(pixels)
    caster = RayMeshIntersector(mesh)
    face = caster.intersects_first(np.tile(eye, (len(rays), 1)), rays)
    light = np.array([0.3, -0.8, 0.9]) / np.linalg.norm([0.3, -0.8, 0.9])
    bright = 0.35 + 0.6 * np.clip(mesh.face_normals[face] @ light, 0, 1)
    image = np.where(face[:, None] >= 0, bright[:, None] * np.array([0.75, 0.82, 0.95]), 1.0)
    return image.reshape(pixels, pixels, 3)


def camera(pixels: int) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "r 3"]]:
    """Eye and rays of a square picture of the canonical box, z up."""
    forward = -EYE / np.linalg.norm(EYE)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    x, y = np.meshgrid(np.linspace(-1, 1, pixels), np.linspace(1, -1, pixels))
    rays = forward + 0.33 * (x[..., None] * right + y[..., None] * up)
    return EYE, (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).reshape(-1, 3)


def seen_points(shards: Sequence[Path], solid: SourceMesh, pixels: int = 260) -> Float[np.ndarray, "h w 3"]:
    """The points of three of the 24 depth views, a color each."""
    view = open_shards(list(shards), "train")
    row = next((k for k, m in enumerate(view.meta) if m["name"] == solid.name), 0)
    points = view[row]["views"].astype(np.float64)
    nearest = np.argsort(-(view_directions() @ (EYE / np.linalg.norm(EYE))))[[0, 2, 4]]
    image = np.ones((pixels, pixels, 3))
    colors = np.array([[0.85, 0.37, 0.01], [0.11, 0.62, 0.47], [0.46, 0.44, 0.70]])
    forward = -EYE / np.linalg.norm(EYE)
    right = np.cross(forward, [0, 0, 1.0]) / np.linalg.norm(np.cross(forward, [0, 0, 1.0]))
    up = np.cross(right, forward)
    for k, color in zip(nearest, colors, strict=True):
        offset = points[k] - EYE
        depth = offset @ forward
        column = ((offset @ right) / depth / 0.33 + 1) / 2 * (pixels - 1)
        line = (1 - (offset @ up) / depth / 0.33) / 2 * (pixels - 1)
        inside = (column >= 0) & (column < pixels - 1) & (line >= 0) & (line < pixels - 1)
        image[line[inside].astype(int), column[inside].astype(int)] = color
    return image


def slices(solid: SourceMesh, pixels: int = 180) -> list[Float[np.ndarray, "h w 3"]]:
    """Signed distance on the three middle planes: blue inside, red outside, a dark line at zero."""
    import point_cloud_utils as pcu

    axis = np.linspace(-BOX, BOX, pixels)
    a, b = np.meshgrid(axis, -axis)
    pictures = []
    for points in (np.stack([a, 0 * a, b], -1), np.stack([0 * a, a, b], -1), np.stack([a, b, 0 * a], -1)):
        query = np.ascontiguousarray(points.reshape(-1, 3))
        distance, _, _ = pcu.closest_points_on_mesh(
            query, np.ascontiguousarray(solid.vertices), np.ascontiguousarray(solid.faces, np.int32)
        )
        signed = np.where(is_inside(solid.vertices, solid.faces, query), -distance, distance)
        share = np.clip(np.abs(signed) / 0.3, 0, 1)[:, None]
        color = np.where(signed[:, None] < 0, [[0.1, 0.3, 0.8]], [[0.8, 0.25, 0.1]])
        picture = 1 - (0.25 + 0.75 * share) * (1 - color)
        bands = (np.abs((signed / 0.05) % 1) < 0.06)[:, None]
        picture = np.where(bands, picture * 0.85, picture)
        pictures.append(np.where(distance[:, None] < 0.004, 0.1, picture).reshape(pixels, pixels, 3))
    return pictures


def save(image: Float[np.ndarray, "h w 3"], path: Path) -> None:
    """Writes a PNG."""
    from PIL import Image

    Image.fromarray((np.clip(image, 0, 1) * 255).astype(np.uint8)).quantize(128).save(path, optimize=True)


if __name__ == "__main__":
    run(main)
