"""Rooms of furniture visited several times and scanned, with all that is true of them: the open FlyingShape.

Imports train.furniture and more2_jax.
"""
