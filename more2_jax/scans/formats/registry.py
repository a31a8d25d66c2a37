"""The formats of scans, the most particular first: the first that recognizes a path reads it.

A format is a module of this package with `recognizes(path) -> bool`, which looks and never raises, and
`read(path, options) -> LabeledCloud`, which raises ValueError, in one line, on what it cannot read.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from more2_jax.scans.formats import (
    arkitscenes,
    e57,
    las,
    mesh_scene,
    npz_scan,
    pcd,
    ply_folder,
    ply_scan,
    replica,
    s3dis,
    scannet,
    scannetpp,
    threerscan,
)
from more2_jax.scans.labeled_cloud import LabeledCloud, ReadOptions


class Format(Protocol):
    """What a format's module offers."""

    def recognizes(self, path: Path) -> bool:
        """Whether the path is of this format, judged by names; never raises."""
        ...

    def read(self, path: Path, options: ReadOptions) -> LabeledCloud:
        """The points and their instances. ValueError, in one line, if that fails."""
        ...


FORMATS: tuple[Format, ...] = (
    threerscan,
    arkitscenes,
    scannet,
    scannetpp,
    replica,
    s3dis,
    ply_scan,
    npz_scan,
    pcd,
    las,
    mesh_scene,
    e57,
    ply_folder,
)
WITH_DEPTH_FRAMES: tuple[Format, ...] = (threerscan,)
