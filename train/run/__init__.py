"""A training run: its state and steps, schedule, devices, checkpoints, validation, and what it writes down.

May import `train.rooms`, `train.shards`, `train.furniture`, `more2_jax`.
"""
