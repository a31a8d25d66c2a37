"""Packs masks of simulated scans as training shapes: `python -m train.tools.scanned --rooms rooms/train_mix --out OUT`.

Rooms are of `train.synthesize --regime real`, furnished with training furniture. Every mask is a shape: its views are
random parts of the mask's points, with the flaws that the scan and the mask have, so that `train.prior` adds none;
its distances are those of the true, closed model. Beside it, `OUT.credits.tsv` has every model's source and license.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.progress import track

from more2_jax.geometry.poses import Pose, apply_pose
from more2_jax.types import Instance
from train.furniture.closed_solids import canonical, canonical_frame
from train.furniture.source_mesh import name_digest
from train.rooms.scene_files import read_scene
from train.rooms.visits import FlyingScene, TrueObject
from train.run.program import run
from train.shards.packed_shapes import HALF, write_shapes
from train.shards.settings import NORMAL_STEPS
from train.shards.signed_distance import signed_distances
from train.tools.pack import write_credits

FEWEST_POINTS = 100  # of a mask, within the box


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """How much is kept of a mask; all files of one training run agree in the first two."""

    views: int = 12
    points: int = 256
    queries: int = 1500


def main(rooms: tuple[Path, ...], out: Path, most: int | None = None, sizes: Sizes = Sizes()) -> None:
    """Writes one packed file, all of it for training: validation needs other models, hence other rooms.

    Args:
        rooms: folders that `train.synthesize --regime real` wrote.
        out: the .npz to write.
        most: masks of one model, at most; by default all.
        sizes: how much is kept of a mask.
    """
    scenes = [s for folder in rooms for s in sorted(folder.glob("scene_????"))]
    if not scenes:
        raise ValueError(f"{', '.join(map(str, rooms))}: no scenes; `python -m train.synthesize` makes them")
    queries: dict[str, dict[str, np.ndarray]] = {}  # by model
    masks: dict[str, list[dict[str, np.ndarray]]] = {}
    credits: dict[str, dict[str, str]] = {}
    for folder in track(scenes, description="rooms"):
        scene = read_scene(folder)
        for o in scene.objects:
            if o.model not in queries:
                queries[o.model] = model_queries(o, sizes.queries)
            masks[o.model] = [*masks.get(o.model, []), *masks_of(scene, o, sizes)][:most]
            credits[o.model] = {"name": o.model, "source": o.source, "license": o.license}
    rows = [queries[model] | mask for model, of_model in masks.items() for mask in of_model]
    if not rows:
        raise ValueError(f"{len(scenes)} scenes, no mask of {FEWEST_POINTS} points with normals; needed some")
    out.parent.mkdir(parents=True, exist_ok=True)
    write_shapes(out, {"train": stacked(rows)})
    write_credits(out.with_suffix(".credits.tsv"), list(credits.values()))
    print(f"{out}: {len(rows)} masks of {len(credits)} models, {out.stat().st_size / 1e6:.1f} MB")


def stacked(rows: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The arrays of `write_shapes`."""
    arrays = {name: np.stack([r[name] for r in rows]) for name in rows[0]}
    return arrays | {"scanned": np.ones(len(rows), np.uint8)}


def model_queries(o: TrueObject, count: int) -> dict[str, np.ndarray]:
    """Signed distances of the closed model, canonical units; they depend on it and its name alone."""
    vertices, _ = canonical(np.asarray(o.vertices, np.float64))
    rng = np.random.default_rng(name_digest(o.model) % 2**32)
    uniform, near = signed_distances(vertices, o.faces, rng, count)
    return {"sdf_uniform": uniform, "sdf_near": near}


def masks_of(scene: FlyingScene, o: TrueObject, sizes: Sizes) -> Iterator[dict[str, np.ndarray]]:
    """Views and normals of each mask that is mostly the object's and has enough points in the box."""
    for k in sorted(set(o.T_scan_model) - o.merged):
        own = set(o.parts.get(k, ())) | {o.instance.get(k, -1)}
        for mask in (i for i in scene.scans[k].instances if i.id in own):
            seed = name_digest(f"{scene.name} {k} {mask.id}") % 2**32
            views = views_of(o, o.T_scan_model[k], mask, sizes, np.random.default_rng(seed))
            if views is not None:
                yield views


def views_of(
    o: TrueObject, T_scan_model: Pose, mask: Instance, sizes: Sizes, rng: np.random.Generator
) -> dict[str, np.ndarray] | None:
    """Random parts of one mask, canonical units of its model; None without normals, or of few points in the box."""
    if mask.normals is None:
        return None
    center, scale = canonical_frame(np.asarray(o.vertices, np.float64))
    points = (apply_pose(np.linalg.inv(T_scan_model), np.asarray(mask.points, np.float64)) - center) / scale
    normals = np.asarray(mask.normals, np.float64) @ T_scan_model[:3, :3]
    held = np.flatnonzero((np.abs(points) < HALF).all(axis=1))
    if len(held) < FEWEST_POINTS:
        return None
    rows = np.stack([np.resize(rng.permutation(held), sizes.points) for _ in range(sizes.views)])
    steps = np.rint(NORMAL_STEPS * normals[rows]).astype(np.int8)
    return {"views": points[rows].astype(np.float16), "normals": steps}


if __name__ == "__main__":
    run(main)
