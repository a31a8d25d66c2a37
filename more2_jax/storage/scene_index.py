"""An index over many stored living scenes: what each object is like and where it stands, to find it elsewhere.

A file of plain arrays, one row an object: F_inv, F_s, extents, place, scene, id. They are not compressed, so a look-up
reads codes and sizes where they lie, some rows at a time, and keeps the best; of the rest only the rows it shows.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from more2_jax.storage.mapped_arrays import mapped_arrays
from more2_jax.storage.scene_folder import DAMAGE, load_scene
from more2_jax.types import LivingScene, SceneObject
from more2_jax.whole_file import check_writable, whole_file

VERSION = 1
SIZE_WEIGHT = 0.5  # of |log| of the ratio of the F_s, as `EvidenceMatcher.size_weight`
ROWS_AT_ONCE = 65_536  # that a look-up compares: 25 MB of codes of 96 numbers


@dataclass(frozen=True, kw_only=True)
class SceneIndex:
    """Objects of many scenes, whose codes one prior made; k rows."""

    prior: str
    inv: Float[np.ndarray, "k c"]  # F_inv, of unit length, float32
    scale: Float[np.ndarray, " k"]  # F_s, meters
    extent_m: Float[np.ndarray, "k 3"]  # of what was seen, along the axes of the scene's frame
    place_m: Float[np.ndarray, "k 3"]  # its middle, where it was seen last, in the scene's frame
    scene: np.ndarray  # folders,
    object: np.ndarray  # ids,
    label: np.ndarray  # labels ("" without), and
    scan: np.ndarray  # names of the scans that saw them last; strings
    there: np.ndarray  # whether that is the scene's last scan

    def __len__(self) -> int:
        return len(self.scale)


@dataclass(frozen=True, kw_only=True)
class Hit:
    """An object of the index that is like the one asked for."""

    row: int
    score: float  # likeness less a difference in size; no probability
    likeness: float  # cosine of the F_inv


def index_of(scenes: Iterable[tuple[str, LivingScene]]) -> SceneIndex:
    """The index of scenes, each under a name. Raises ValueError of none, and of codes that several priors made."""
    rows, priors = list[dict[str, object]](), dict[str, str]()
    for name, scene in scenes:
        priors.setdefault(scene.prior, name)
        rows += [row_of(name, scene, o) for o in scene.objects]
    if len(priors) > 1:
        (a, first), (b, other), *_ = priors.items()
        raise ValueError(f"{first} has codes of prior {a!r}, {other} of {b!r}; needed one prior for all")
    if not rows:
        raise ValueError("index got no objects; needed a living scene with some")
    columns = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    return SceneIndex(prior=next(iter(priors)), **columns)


def row_of(name: str, scene: LivingScene, o: SceneObject) -> dict[str, object]:
    """One object, where it was seen last."""
    last = o.observations[-1]
    T = last.frame.T_scene_scan @ np.linalg.inv(last.T_ref_scan)
    points = o.points @ T[:3, :3].T + T[:3, 3]
    low, high = points.min(axis=0), points.max(axis=0)
    inv = np.asarray(o.embedding.inv, np.float32)
    return {
        "inv": inv / max(float(np.linalg.norm(inv)), 1e-30),
        "scale": np.float32(o.embedding.scale),
        "extent_m": high - low,
        "place_m": (low + high) / 2,
        "scene": name,
        "object": o.id,
        "label": o.label or "",
        "scan": scene.scans[last.scan].name,
        "there": last.scan == scene.scans[-1].index,
    }


def find(index: SceneIndex, o: SceneObject, count: int, besides: str | None = None) -> list[Hit]:
    """The `count` objects of the index that are most like one, best first; none of the scene called `besides`.

    Raises ValueError for a code of another width.
    """
    inv = np.asarray(o.embedding.inv, np.float32)
    if inv.shape != index.inv.shape[1:]:
        raise ValueError(
            f"{o.id} has a code of {len(inv)} numbers; needed {index.inv.shape[1]}, as the index"
        )
    inv = inv / max(float(np.linalg.norm(inv)), 1e-30)
    best: list[Hit] = []
    for start in range(0, len(index), ROWS_AT_ONCE):
        rows = slice(start, start + ROWS_AT_ONCE)
        likeness = index.inv[rows] @ inv
        score = likeness - SIZE_WEIGHT * np.abs(np.log(index.scale[rows] / np.float32(o.embedding.scale)))
        order = start + np.argsort(-score, kind="stable")
        others = (k for k in map(int, order) if besides is None or index.scene[k] != besides)
        best += [
            Hit(row=k, score=float(score[k - start]), likeness=float(likeness[k - start]))
            for k in itertools.islice(others, count)
        ]
        best = sorted(best, key=lambda hit: -hit.score)[:count]
    return best


def index_folders(folders: Iterable[Path]) -> SceneIndex:
    """The index of stored scenes, one in memory at a time. Raises ValueError as `load_scene` and `index_of` do."""
    return index_of((str(folder.resolve()), load_scene(folder)[0]) for folder in folders)


def save_index(index: SceneIndex, path: Path) -> None:
    """Writes it, whole or not at all. Raises ValueError where its folder cannot be written."""
    check_writable(path)
    with whole_file(path) as partial, partial.open("wb") as file:
        np.savez(file, version=np.array(VERSION), **vars(index))


def load_index(path: Path) -> SceneIndex:
    """The index in a file, whose arrays stay there until they are looked at.

    Raises ValueError, in one line, where it is missing, damaged or of another version.
    """
    if not path.is_file():
        raise ValueError(f"{path}: no such index; `more2 index` makes one")
    try:
        found = mapped_arrays(path)
        version, prior = int(found["version"]), str(found["prior"])
        arrays = {f.name: found[f.name] for f in dataclasses.fields(SceneIndex) if f.name != "prior"}
    except DAMAGE as error:
        raise ValueError(f"{path}: not an index ({' '.join(str(error).split())})") from error
    if version != VERSION:
        raise ValueError(f"{path}: version {version} of an index; needed {VERSION}")
    return SceneIndex(prior=prior, **arrays)
