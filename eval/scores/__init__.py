"""From what a method says to figures: scores of matches, poses, meshes and tracks, and their statistics.

Imports eval.data, train.furniture and more2_jax.
"""
