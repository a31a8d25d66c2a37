"""Benchmarks as scenes with their truth, in one form: FlyingShape, 3RScan, true, damaged or predicted masks.

May import `train`, `more2_jax`.
"""
