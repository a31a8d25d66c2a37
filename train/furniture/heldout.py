"""Furniture for evaluation, of sources that no training uses: meters, z up, standing on z = 0."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from train.furniture.collections import SourceMesh, read_meshes, standing
from train.furniture.sweethome3d import Z_UP

IKEA_LICENSE = "CC-BY-4.0; IKEA-Manuals-at-Work"
# The collection comes without a scale: the longest edge that such a piece usually has, meters.
IKEA_LONGEST_M = {"Bench": 1.0, "Chair": 0.85, "Desk": 1.2, "Misc": 0.8, "Shelf": 1.2, "Table": 1.0}


def read_ikea(path: str | Path) -> Iterator[SourceMesh]:
    """The IKEA products of a packed .npz (y up, any scale; named `Category_product`), at a plausible size.

    Raises ValueError if the file is not a collection, or names a category without a size.
    """
    for mesh in read_meshes(path):
        category = mesh.name.split("_")[0]
        if category not in IKEA_LONGEST_M:
            raise ValueError(f"{mesh.name}: category {category!r}; needed one of {', '.join(IKEA_LONGEST_M)}")
        vertices = mesh.vertices @ Z_UP.T
        vertices = vertices * (IKEA_LONGEST_M[category] / np.ptp(vertices, axis=0).max())
        yield dataclasses.replace(
            mesh, category=category.lower(), vertices=standing(vertices), license=IKEA_LICENSE
        )
