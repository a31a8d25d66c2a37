"""Parametric furniture."""

from more2_jax.data.procedural.furniture import CATEGORIES, procedural_mesh, procedural_meshes

__all__ = ["CATEGORIES", "procedural_mesh", "procedural_meshes"]
