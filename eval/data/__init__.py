"""Benchmarks in one form: known scenes of FlyingShape and 3RScan, their truth, and masks that are not.

Imports train.rooms, train.furniture and more2_jax.
"""
