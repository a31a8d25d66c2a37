"""Packs shards into one small file: `python -m train.tools.pack --shards data/real … --out small.npz`.

For machines that the shards (gigabytes) cannot be brought to; `train.prior --shards small.npz` reads it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from train.run.program import run
from train.shards.packed_shapes import write_shapes
from train.shards.shards import MAPPED, open_shards


def main(
    shards: tuple[Path, ...],
    out: Path,
    shapes: int = 1500,
    val: int = 192,
    views: int = 12,
    points: int = 256,
    queries: int = 1500,
    seed: int = 0,
) -> None:
    """Takes shapes at random from all folders together, and of each the first views, points and queries.

    Args:
        shards: folders that `train.prepare` wrote; one named twice counts twice in the choice.
        out: the .npz to write.
        shapes: of the training split.
        val: shapes of the validation split.
        views: a shape.
        points: a view.
        queries: a shape, of each kind: uniform, and near the surface.
        seed: of the choice.
    """
    rng = np.random.default_rng(seed)
    seen, asked = (views, points), (queries,)
    sizes = {"views": seen, "normals": seen, "sdf_uniform": asked, "sdf_near": asked}
    splits = {
        split: _chosen(shards, split, count, sizes, rng) for split, count in (("train", shapes), ("val", val))
    }
    write_shapes(out, splits)
    counts = ", ".join(f"{len(arrays['views'])} {split}" for split, arrays in splits.items())
    print(f"{out}: {counts} shapes, {out.stat().st_size / 1e6:.1f} MB")


def _chosen(
    shards: tuple[Path, ...],
    split: str,
    count: int,
    sizes: dict[str, tuple[int, ...]],
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    view = open_shards(shards, split)
    index = np.sort(rng.permutation(len(view))[:count])
    kept = {name: tuple(slice(n) for n in sizes[name]) for name in MAPPED}
    return {name: np.stack([view[int(i)][name][kept[name]] for i in index]) for name in MAPPED}


if __name__ == "__main__":
    run(main)
