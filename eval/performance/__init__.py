"""Yardsticks of speed: a stopwatch, and the published layers written plainly in JAX and in PyTorch.

Imports more2_jax.
"""
