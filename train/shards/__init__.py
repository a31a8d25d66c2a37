"""Training shapes as arrays: solids to signed distances and depth views, shards on disk, samples, losses.

May import `train.furniture`, `more2_jax`.
"""
