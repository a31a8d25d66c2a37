"""Meshes to training shards: `python -m train.prepare --source MESHES … --out data/shards`.

A shard is a folder of 64 shapes in canonical units; shapes are shuffled over all sources by a hash of their
name, so the first shards are already a balanced mix. Finished shards are kept: a stopped run resumes.
"""

from __future__ import annotations

import hashlib
import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path

from rich.progress import track

from more2_jax.whole_file import whole_file
from train.furniture.collections import SourceMesh, read_meshes
from train.furniture.heldout import read_ikea
from train.furniture.parallel_map import Workers
from train.furniture.procedural import Recipe, procedural_recipes
from train.run.program import run
from train.shards.shapes import Shape, make_shape
from train.shards.shards import write_shard

SHARD = 64


def main(
    out: Path,
    source: tuple[Path, ...] = (),
    held_out: tuple[Path, ...] = (),
    procedural: int = 0,
    most_per_source: int | None = None,
    limit: int | None = None,
    workers: int = 0,
    ray: str | None = None,
) -> None:
    """Prepares shapes for training.

    Args:
        out: folder of the shards and of report.json (what was left out, and why).
        source: packed .npz collections, SweetHome3D catalogs (.sh3f), ShapeNet's folder, .csv tables with a
            column path (and category, split, license), or folders of OBJ, GLB, OFF, PLY or STL files.
        held_out: sources of the test split, which is never trained on.
        procedural: parametric furniture, so many pieces in all.
        most_per_source: of one collection, so that none outweighs the others.
        limit: stop after so many meshes, counted in the shuffled order.
        workers: processes; 0 for one a core.
        ray: address of a Ray cluster to spread the work over instead ("local" starts one here).
    """
    unreadable: dict[str, str] = {}
    meshes: list[SourceMesh | Recipe] = [*procedural_recipes(procedural)]
    for path in source:
        meshes += _read(path, most_per_source, unreadable)
    for path in held_out:
        meshes += [replace(m, split="test") for m in _read(path, most_per_source, unreadable)]
    meshes = sorted(meshes, key=lambda m: (m.digest, m.source))[:limit]
    if not meshes:
        raise ValueError("no meshes in the sources, and --procedural 0; needed at least one")
    out.mkdir(parents=True, exist_ok=True)
    report = Report.open(out / "report.json", meshes, unreadable)
    make_shards(out, meshes, report, workers, ray)
    print(
        f"{len(meshes) - len(report.rejected)} shapes, {len(report.rejected)} rejected,"
        f" {len(report.unreadable)} not read ({report.path})"
    )


def make_shards(
    out: Path, meshes: list[SourceMesh | Recipe], report: Report, workers: int, ray: str | None
) -> None:
    """Writes the shards that are not there yet."""
    starts = range(0, len(meshes), SHARD)
    with Workers(workers, ray) as pool:
        for start in track(starts, description="shards", disable=not sys.stdout.isatty()):
            path = out / f"shard_{start // SHARD:03d}"
            if path.exists():
                continue
            results = list(pool.map(prepare, meshes[start : start + SHARD]))
            report.rejected.update({r.name: r.reason for r in results if isinstance(r, Rejected)})
            report.write()
            write_shard(path, [r for r in results if isinstance(r, Shape)])


def _read(path: Path, most: int | None, unreadable: dict[str, str]) -> list[SourceMesh]:
    if path.stem == "heldout_ikea":  # y up, and of any size
        meshes = read_ikea(path)
    else:
        meshes = read_meshes(path, report=lambda name, why: unreadable.update({name: why}))
    return sorted(meshes, key=lambda m: m.digest)[:most]


@dataclass(frozen=True, kw_only=True)
class Rejected:
    """A mesh that cannot be used, and why."""

    name: str
    reason: str


def prepare(mesh: SourceMesh | Recipe) -> Shape | Rejected:
    """One shape, or the reason why the mesh cannot be used."""
    try:
        return make_shape(mesh.mesh() if isinstance(mesh, Recipe) else mesh)
    except ValueError as error:
        return Rejected(name=mesh.name, reason=str(error))


@dataclass(frozen=True, kw_only=True)
class Report:
    """Which meshes a folder of shards is made of, and which of them were left out."""

    path: Path
    digest: str  # of all the meshes' names
    rejected: dict[str, str]  # name → reason
    unreadable: dict[str, str]  # name → reason, of files that did not become a mesh

    @classmethod
    def open(cls, path: Path, meshes: list[SourceMesh | Recipe], unreadable: dict[str, str]) -> Report:
        """The report so far. Raises ValueError if the folder's shards are of other meshes."""
        digest = hashlib.sha1("\n".join(m.name for m in meshes).encode()).hexdigest()
        found = json.loads(path.read_text()) if path.exists() else {"digest": digest, "rejected": {}}
        if found["digest"] != digest:
            raise ValueError(
                f"{path.parent}: shards of other meshes; needed the same ones, or another folder"
            )
        return cls(path=path, digest=digest, rejected=found["rejected"], unreadable=unreadable)

    def write(self) -> None:
        """Writes atomically."""
        content = {"digest": self.digest, "rejected": self.rejected, "unreadable": self.unreadable}
        with whole_file(self.path) as partial:
            partial.write_text(json.dumps(content, indent=1))


if __name__ == "__main__":
    run(main)
