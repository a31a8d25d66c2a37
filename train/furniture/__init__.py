"""Meshes of furniture: collections as they come, closed solids made of them, symmetries, procedural pieces.

May import `more2_jax.geometry`, `more2_jax.types`, `more2_jax.workers`.
"""
