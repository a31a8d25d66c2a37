"""Parametric furniture."""

from train.furniture.procedural.furniture import (
    CATEGORIES,
    Recipe,
    procedural_mesh,
    procedural_recipes,
)

__all__ = ["CATEGORIES", "Recipe", "procedural_mesh", "procedural_recipes"]
