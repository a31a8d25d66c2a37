"""Packs shards into one small file: `python -m train.tools.pack --shards data/real … --out small.npz`.

For machines that the shards (gigabytes) cannot be brought to; `train.prior --shards small.npz` reads it. Beside it,
`small.credits.tsv` has name, source and license of every shape: a copy of the file must take it along.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from train.run.program import run
from train.shards.packed_shapes import write_shapes
from train.shards.shards import MAPPED, open_shards

CREDIT = ("name", "source", "license")


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
    splits: dict[str, dict[str, np.ndarray]] = {}
    credit: list[Mapping[str, Any]] = []
    for split, count in (("train", shapes), ("val", val)):
        splits[split], rows = _chosen(shards, split, count, sizes, rng)
        credit += rows
    out.parent.mkdir(parents=True, exist_ok=True)
    write_shapes(out, splits)
    write_credits(out.with_suffix(".credits.tsv"), credit)
    counts = ", ".join(f"{len(arrays['views'])} {split}" for split, arrays in splits.items())
    print(f"{out}: {counts} shapes, {out.stat().st_size / 1e6:.1f} MB")


def _chosen(
    shards: tuple[Path, ...],
    split: str,
    count: int,
    sizes: dict[str, tuple[int, ...]],
    rng: np.random.Generator,
) -> tuple[dict[str, np.ndarray], list[Mapping[str, Any]]]:
    view = open_shards(shards, split)
    index = np.sort(rng.permutation(len(view))[:count])
    kept = {name: tuple(slice(n) for n in sizes[name]) for name in MAPPED}
    arrays = {name: np.stack([view[int(i)][name][kept[name]] for i in index]) for name in MAPPED}
    return arrays, [view.meta[int(i)] for i in index]


def write_credits(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """A line a shape: name, source, license with its author."""
    lines = sorted({tuple(" ".join(str(m.get(k, "unknown")).split()) for k in CREDIT) for m in rows})
    path.write_text("".join("\t".join(line) + "\n" for line in [CREDIT, *lines]))


if __name__ == "__main__":
    run(main)
