"""Training shards: folders of arrays, from `python -m train.prepare`, in memory or mapped from disk.

`DIR/shard_000/` holds views.npy, normals.npy, sdf_uniform.npy, sdf_near.npy, fingerprint.npy, meta.json (a row a
shape) and meshes.npz (the closed solids, packed). `DIR/excluded.json` names shapes that no split may use.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int8

from more2_jax.types import pytree
from train.furniture.packed import read_packed, write_packed
from train.furniture.source_mesh import SourceMesh

if TYPE_CHECKING:  # making shapes needs the extra `data`, training on them does not
    from train.shards.shapes import Shape

MAPPED = ("views", "normals", "sdf_uniform", "sdf_near")  # what samples are drawn from
ARRAYS = (*MAPPED, "fingerprint")
EXCLUDED = "excluded.json"


@pytree
class Shapes:
    """Training shapes in canonical units (centered, longest edge 0.9), float16."""

    views: Float[Array, "shapes views n 3"]  # back-projected depth maps
    normals: Int8[Array, "shapes views n 3"]  # outward unit normals there, times `NORMAL_STEPS`
    sdf_uniform: Float[Array, "shapes q 4"]  # x y z and signed distance, negative inside
    sdf_near: Float[Array, "shapes q 4"]
    scanned: Bool[Array, " shapes"]  # views are parts of a scan, with flaws of their own: none are added


@dataclass(frozen=True, kw_only=True)
class ShardView(Sequence[Mapping[str, np.ndarray]]):
    """The shapes of one split, mapped from disk: nothing is read before it is asked for."""

    shards: tuple[Mapping[str, np.ndarray], ...]  # of each shard, its arrays
    rows: tuple[tuple[int, int], ...]  # shard, row
    meta: tuple[Mapping[str, Any], ...]

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: int) -> Mapping[str, np.ndarray]:  # pyright: ignore[reportIncompatibleMethodOverride]
        shard, row = self.rows[index]
        return {name: array[row] for name, array in self.shards[shard].items()}


def write_shard(path: Path, shapes: Sequence[Shape]) -> None:
    """Writes a shard atomically; an empty one too, so that a resumed run does not try its meshes again."""
    partial = path.with_suffix(".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    if shapes:
        for name in ARRAYS:
            np.save(partial / f"{name}.npy", np.stack([getattr(s, name) for s in shapes]))
        write_packed(partial / "meshes.npz", [_solid(s) for s in shapes])
    (partial / "meta.json").write_text(json.dumps([s.meta for s in shapes], indent=0))
    partial.replace(path)


def _solid(shape: Shape) -> SourceMesh:
    kept = {k: shape.meta[k] for k in ("name", "category", "source", "license")}
    return SourceMesh(vertices=shape.vertices, faces=shape.faces, **kept)


def shard_folders(folder: str | Path) -> list[Path]:
    """The finished shards of a folder, in order. ValueError if there is none."""
    found = sorted(p.parent for p in Path(folder).glob("shard_*/meta.json") if p.parent.suffix != ".partial")
    if not found:
        raise ValueError(f"{folder}: no shards; `python -m train.prepare` makes them")
    return found


def read_meta(shard: Path) -> list[dict[str, Any]]:
    """The rows of one shard. ValueError if they cannot be read."""
    try:
        return json.loads((shard / "meta.json").read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{shard}: not a readable shard ({error})") from error


def excluded(folder: str | Path) -> frozenset[str]:
    """Names of shapes that no split may use: near-duplicates across splits, see `duplicates`."""
    path = Path(folder) / EXCLUDED
    return frozenset(json.loads(path.read_text())["names"]) if path.exists() else frozenset()


def open_shards(folders: str | Path | Sequence[str | Path], split: str) -> ShardView:
    """The shapes of `split` ('train', 'val', 'test') in one or several folders. ValueError if there is none."""
    given = [folders] if isinstance(folders, str | Path) else list(folders)
    shards, rows, meta = [], [], []
    for folder in given:
        left_out = excluded(folder)
        for shard in shard_folders(folder):
            found = read_meta(shard)
            chosen = [k for k, m in enumerate(found) if m["split"] == split and m["name"] not in left_out]
            if chosen:
                rows += [(len(shards), k) for k in chosen]
                meta += [found[k] for k in chosen]
                shards.append(mapped(shard))
    if not rows:
        raise ValueError(
            f"{', '.join(map(str, given))}: no {split} shapes; `python -m train.prepare` makes them"
        )
    return ShardView(shards=tuple(shards), rows=tuple(rows), meta=tuple(meta))


def mapped(shard: Path) -> dict[str, np.ndarray]:
    """The arrays of a shard that samples are drawn from; one without normals.npy has none that are known."""
    found = {n: np.load(shard / f"{n}.npy", mmap_mode="r") for n in MAPPED if (shard / f"{n}.npy").exists()}
    return {"normals": np.broadcast_to(np.int8(0), found["views"].shape)} | found


def read_solids(shard: Path) -> list[SourceMesh]:
    """The closed solids of one shard, canonical units, in the order of its rows."""
    path = shard / "meshes.npz"
    return list(read_packed(path)) if path.exists() else []
