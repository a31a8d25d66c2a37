"""Meshes to training shards: `python -m train.prepare --source MESHES.npz … --out data/shards`.

A shard is an .npz of 64 shapes in canonical units; shapes are shuffled over all sources by a hash of their
name, so the first shards are already a balanced mix. Finished shards are kept: a stopped run resumes.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

from more2_jax.data.depth_views import depth_views
from more2_jax.data.meshes import SourceMesh, check_mesh, read_meshes
from more2_jax.data.procedural import procedural_meshes
from more2_jax.data.signed_distance import canonical, signed_distances
from train.program import run

SHARD = 64
VALIDATION_SHARE = 10  # one in so many models


def main(
    out: Path,
    source: tuple[Path, ...] = (),
    procedural: int = 0,
    most_per_source: int = 110,
    limit: int | None = None,
    workers: int = 0,
) -> None:
    """Prepares shapes for training.

    Args:
        out: folder of the shards and of report.json (what was left out, and why).
        source: packed .npz collections or folders of meshes.
        procedural: parametric benches, beds, cushions, trash cans, stools and sofas, so many in all.
        most_per_source: of one collection, so that none outweighs the others.
        limit: stop after so many meshes, counted in the shuffled order.
        workers: processes; 0 for one a core.
    """
    meshes = list(procedural_meshes(procedural))
    for path in source:
        meshes += [m for m, _ in zip(read_meshes(path), range(most_per_source), strict=False)]
    if not meshes:
        raise ValueError("no meshes in the sources, and --procedural 0; needed at least one")
    meshes = sorted(meshes, key=lambda m: m.digest)[:limit]
    out.mkdir(parents=True, exist_ok=True)
    report = Report.open(out / "report.json", meshes)
    starts = range(0, len(meshes), SHARD)
    quiet = not sys.stdout.isatty()
    with ProcessPoolExecutor(workers or os.cpu_count(), mp_context=get_context("spawn")) as pool:
        for start in track(starts, description="shards", disable=quiet):
            path = out / f"shard_{start // SHARD:03d}.npz"
            if path.exists():
                continue
            results = list(pool.map(prepare, meshes[start : start + SHARD]))
            report.rejected.update({r["name"]: r["reason"] for r in results if "reason" in r})
            report.write()
            write_shard(path, [r for r in results if "reason" not in r])
    left_out = len(report.rejected)
    print(f"{len(meshes) - left_out} shapes in {len(starts)} shards, {left_out} left out ({report.path})")


@dataclass(frozen=True, kw_only=True)
class Report:
    """Which meshes a folder of shards is made of, and which of them were left out."""

    path: Path
    digest: str  # of all the meshes' names
    rejected: dict[str, str]  # name → reason

    @classmethod
    def open(cls, path: Path, meshes: list[SourceMesh]) -> Report:
        """The report so far. Raises ValueError if the folder's shards are of other meshes."""
        digest = hashlib.sha1("\n".join(m.name for m in meshes).encode()).hexdigest()
        found = json.loads(path.read_text()) if path.exists() else {"digest": digest, "rejected": {}}
        if found["digest"] != digest:
            raise ValueError(
                f"{path.parent}: shards of other meshes; needed the same ones, or another folder"
            )
        return cls(path=path, digest=digest, rejected=found["rejected"])

    def write(self) -> None:
        """Writes atomically."""
        partial = self.path.with_suffix(".partial")
        partial.write_text(json.dumps({"digest": self.digest, "rejected": self.rejected}, indent=1))
        partial.replace(self.path)


def prepare(mesh: SourceMesh) -> dict[str, Any]:
    """One shape's arrays, or its name and the reason why it cannot be used."""
    rng = np.random.default_rng(mesh.digest % 2**32)
    try:
        check_mesh(mesh)
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
        "scale_m": np.float32(scale),
    }


def write_shard(path: Path, shapes: list[dict[str, Any]]) -> None:
    """Writes a shard atomically; an empty one too, so that a resumed run does not try its meshes again."""
    keys = ("views", "sdf_uniform", "sdf_near", "names", "categories", "sources", "splits", "scale_m")
    partial = path.with_suffix(".partial")
    with partial.open("wb") as file:
        np.savez(file, **{k: np.array([s[k] for s in shapes]) for k in keys})  # pyright: ignore[reportArgumentType]
    partial.replace(path)


if __name__ == "__main__":
    run(main)
