"""What a training run consists of: settings, batches, state, schedule, checkpoints, validation, journal.

Imports train.shards and more2_jax.
"""
