"""Training shapes: depth views and signed distances of closed pieces, samples drawn of them, and the losses.

Drawing samples and losses are pure JAX; making shapes needs the extra `data`. Imports train.furniture and more2_jax.
"""
