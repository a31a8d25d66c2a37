"""What speed is compared with: plain layers in JAX and PyTorch, and a stopwatch.

May import `more2_jax`.
"""
