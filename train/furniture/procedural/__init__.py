"""Parametric furniture: a recipe a category, built of shared parts, drawn by seed.

May import `train.furniture.source_mesh`.
"""

from train.furniture.procedural.furniture import (
    CATEGORIES,
    Recipe,
    procedural_mesh,
    procedural_recipes,
)

__all__ = ["CATEGORIES", "Recipe", "procedural_mesh", "procedural_recipes"]
