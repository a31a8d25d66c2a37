"""Furniture to learn from: collections of meshes read, closed, told apart, and pieces made by rule.

Needs the extra `data`. Imports more2_jax and nothing else of the programs.
"""
