"""Meshes that wait in files instead of in memory, where a scene has many: a thousand take more than a gigabyte."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from jaxtyping import Float, Integer

from more2_jax.types import Mesh


class WaitingMesh(Mesh):
    """A mesh in a file: whoever asks for its vertices or faces gets them read anew, to the bit as they were."""

    path: Path

    def __init__(self, path: Path, mesh: Mesh) -> None:
        """Writes `mesh` to `path`."""
        object.__setattr__(self, "path", path)
        with path.open("wb") as file:
            np.save(file, mesh.vertices)
            np.save(file, mesh.faces)

    @property
    def vertices(self) -> Float[np.ndarray, "v 3"]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """As in `Mesh`."""
        return self._read()[0]

    @property
    def faces(self) -> Integer[np.ndarray, "f 3"]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """As in `Mesh`."""
        return self._read()[1]

    def _read(self) -> tuple[np.ndarray, np.ndarray]:
        with self.path.open("rb") as file:
            return np.load(file), np.load(file)


class WaitingMeshes:
    """The `keep` of `reconstruct`: within, meshes wait in a folder of their own, which is removed in the end."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.count = folder, 0

    @classmethod
    def beside(cls, folder: Path) -> WaitingMeshes:
        """In a hidden folder beside that of a living scene."""
        at = folder.resolve()
        return cls(at.with_name(f".{at.name}.meshes"))

    def __enter__(self) -> WaitingMeshes:
        shutil.rmtree(self.folder, ignore_errors=True)  # of a process that was killed
        self.folder.mkdir(parents=True)
        return self

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)

    def __call__(self, mesh: Mesh) -> Mesh:
        """The mesh, written; it can be read until the end."""
        self.count += 1
        return WaitingMesh(self.folder / f"{self.count}.mesh", mesh)
