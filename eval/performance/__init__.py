"""What `python -m eval.speed` times: the network's layers written plainly, in JAX and in PyTorch, and a stopwatch.

Imports `more2_jax.config` alone; `torch_layers` runs in a process of its own and imports PyTorch only.
"""
