"""Furnished rooms, visited and scanned several times by simulated depth cameras, with everything true of them.

May import `train.furniture`, `more2_jax`.
"""
