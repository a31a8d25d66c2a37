"""One mesh as a collection has it, before anything is made of it."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

Split = Literal["train", "val", "test"]
VALIDATION_SHARE = 10  # one in so many models


@dataclass(frozen=True, kw_only=True)
class SourceMesh:
    """One mesh of a collection, as it came: any unit, rarely watertight."""

    name: str
    category: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    source: str
    license: str = "unknown"
    split: Split | None = None  # where the collection says so itself

    @property
    def digest(self) -> int:
        """A number that depends on the name alone: orders and splits collections the same way everywhere."""
        return name_digest(self.name)

    @property
    def content_hash(self) -> str:
        """SHA-1 of the geometry: equal for equal meshes, whatever they are called."""
        geometry = self.vertices.astype("<f4").tobytes() + self.faces.astype("<i4").tobytes()
        return hashlib.sha1(geometry).hexdigest()

    @property
    def chosen_split(self) -> Split:
        """The collection's own split; else one model in ten, by its name, is for validation."""
        if self.split is not None:
            return self.split
        return "val" if self.digest % 2**16 % VALIDATION_SHARE == 0 else "train"


def name_digest(name: str) -> int:
    """A large number that depends on the name alone, the same on every machine."""
    return int(hashlib.sha1(name.encode()).hexdigest(), 16)


def check_mesh(mesh: SourceMesh) -> None:
    """Raises ValueError if the mesh has no surface, or its faces name vertices that do not exist."""
    if not len(mesh.vertices) or not len(mesh.faces):
        raise ValueError(f"{len(mesh.vertices)} vertices, {len(mesh.faces)} faces; needed some of both")
    first, last = int(mesh.faces.min()), int(mesh.faces.max())
    if first < 0 or last >= len(mesh.vertices):
        count = len(mesh.vertices)
        raise ValueError(f"faces name vertices {first} to {last} of {count}; needed ones that exist")


def standing(vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
    """The same shape standing on z = 0, the middle of its footprint at the origin."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return vertices - [*(low + high)[:2] / 2, low[2]]
