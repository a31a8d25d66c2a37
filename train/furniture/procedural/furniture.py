"""Parametric furniture of the kinds that rooms have: meters, z up, standing on z = 0, its front toward -y.

A piece depends on its category and seed alone. It is one closed connected solid: the boolean union of parts
that reach into each other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from train.furniture.procedural.others import lamp, trash_can
from train.furniture.procedural.parts import Rng, union
from train.furniture.procedural.seating import bench, chair, office_chair, stool
from train.furniture.procedural.soft import armchair, bed, pillow, sofa
from train.furniture.procedural.storage import cabinet, shelf
from train.furniture.procedural.tables import desk, table
from train.furniture.source_mesh import SourceMesh, name_digest, standing

if TYPE_CHECKING:
    from manifold3d import Manifold

CRUMB = 1e-6  # m³; a boolean of curved parts can leave splinters where they nearly touch

CATEGORIES: dict[str, Callable[[Rng], list[Manifold]]] = {
    "bench": bench,
    "bed": bed,
    "pillow": pillow,
    "trash can": trash_can,
    "stool": stool,
    "sofa": sofa,
    "chair": chair,
    "office chair": office_chair,
    "armchair": armchair,
    "table": table,
    "desk": desk,
    "cabinet": cabinet,
    "shelf": shelf,
    "lamp": lamp,
}


@dataclass(frozen=True)
class Recipe:
    """A piece that is not made yet: what workers are sent instead of meshes."""

    category: str
    seed: int
    source: str = "procedural"

    @property
    def name(self) -> str:
        """The name of the mesh."""
        return f"procedural_{self.category.replace(' ', '_')}_{self.seed:04d}"

    @property
    def digest(self) -> int:
        """The mesh's digest."""
        return name_digest(self.name)

    def mesh(self) -> SourceMesh:
        """Makes the piece."""
        return procedural_mesh(self.category, self.seed)


def procedural_recipes(count: int, first: int = 0) -> list[Recipe]:
    """`count` pieces, the categories in turn, beginning with the piece of number `first`.

    Piece k is seed k // 14 of category k % 14, so that ranges can be made apart. Raises ValueError if either
    number is negative.
    """
    if count < 0 or first < 0:
        raise ValueError(f"{count} procedural meshes from number {first}; needed 0 or more of both")
    categories = list(CATEGORIES)
    return [
        Recipe(categories[k % len(categories)], k // len(categories)) for k in range(first, first + count)
    ]


def procedural_mesh(category: str, seed: int) -> SourceMesh:
    """One piece of furniture. Raises ValueError for a category not in `CATEGORIES` or a negative seed."""
    if category not in CATEGORIES:
        raise ValueError(f"category {category!r}; needed one of {', '.join(CATEGORIES)}")
    if seed < 0:
        raise ValueError(f"seed {seed}; needed 0 or more")
    rng = np.random.default_rng([name_digest(category) % 2**64, seed])
    mesh = _filled(union(CATEGORIES[category](rng))).to_mesh64()
    return SourceMesh(
        name=Recipe(category, seed).name,
        category=category,
        vertices=standing(np.array(mesh.vert_properties[:, :3], np.float64)),
        faces=np.array(mesh.tri_verts, np.int64),
        source="procedural",
        license="MIT; this project's own",
    )


def _filled(solid: Manifold) -> Manifold:
    """Without the hollows that nothing outside reaches (surfaces of negative volume), and without crumbs."""
    return union([part for part in solid.decompose() if part.volume() > CRUMB])
