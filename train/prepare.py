"""Meshes to training shards: `python -m train.prepare --source MESHES.npz … --out data/shards`.

A shard is an .npz of 64 shapes in canonical units; shapes are shuffled over all sources by a hash of their
name, so the first shards are already a balanced mix. Finished shards are kept: a stopped run resumes.
"""

from __future__ import annotations

import json
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

from more2_jax.data.depth_views import depth_views
from more2_jax.data.meshes import SourceMesh, read_meshes
from more2_jax.data.signed_distance import canonical, signed_distances
from train.program import run

SHARD = 64
VALIDATION_SHARE = 10  # one in so many models


def main(source: tuple[Path, ...], out: Path, most_per_source: int = 110, workers: int = 0) -> None:
    """Prepares shapes for training.

    Args:
        source: packed .npz collections or folders of meshes.
        out: folder of the shards and of report.json (what was left out, and why).
        most_per_source: of one collection, so that none outweighs the others.
        workers: processes; 0 for one a core.
    """
    meshes: list[SourceMesh] = []
    for path in source:
        meshes += [m for m, _ in zip(read_meshes(path), range(most_per_source), strict=False)]
    if not meshes:
        raise ValueError("no meshes in the sources; needed at least one")
    meshes.sort(key=lambda m: m.digest)
    out.mkdir(parents=True, exist_ok=True)
    report = out / "report.json"
    rejected = json.loads(report.read_text()) if report.exists() else {}
    starts = range(0, len(meshes), SHARD)
    with ProcessPoolExecutor(workers or os.cpu_count(), mp_context=get_context("spawn")) as pool:
        for start in track(starts, description="shards", disable=None):
            path = out / f"shard_{start // SHARD:03d}.npz"
            if path.exists():
                continue
            results = list(pool.map(prepare, meshes[start : start + SHARD]))
            rejected |= {r["name"]: r["reason"] for r in results if "reason" in r}
            write_shard(path, [r for r in results if "reason" not in r])
            report.write_text(json.dumps(rejected, indent=1))
    print(
        f"{len(meshes) - len(rejected)} shapes in {len(starts)} shards, {len(rejected)} left out ({report})"
    )


def prepare(mesh: SourceMesh) -> dict[str, Any]:
    """One shape's arrays, or its name and the reason why it cannot be used."""
    rng = np.random.default_rng(mesh.digest % 2**32)
    try:
        vertices, scale = canonical(mesh.vertices)
        views = depth_views(vertices, mesh.faces, rng)
        uniform, near = signed_distances(vertices, mesh.faces, views.reshape(-1, 3)[::10], rng)
    except ValueError as error:
        return {"name": mesh.name, "reason": str(error)}
    return {
        "views": views.astype(np.float16),
        "sdf_uniform": uniform.astype(np.float16),
        "sdf_near": near.astype(np.float16),
        "names": mesh.name,
        "categories": mesh.category,
        "sources": mesh.source,
        "splits": "val" if mesh.digest % 2**16 % VALIDATION_SHARE == 0 else "train",
        "scale": np.float32(scale),
    }


def write_shard(path: Path, shapes: list[dict[str, Any]]) -> None:
    """Writes a shard atomically; an empty one too, so that a resumed run does not try its meshes again."""
    keys = ("views", "sdf_uniform", "sdf_near", "names", "categories", "sources", "splits", "scale")
    partial = path.with_suffix(".partial")
    with partial.open("wb") as file:
        np.savez(file, **{k: np.array([s[k] for s in shapes]) for k in keys})
    partial.replace(path)


if __name__ == "__main__":
    run(main)
