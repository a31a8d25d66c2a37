"""Programs beside training: bundled scans made, shards packed and counted, a narrow prior widened.

May import `train.run`, `train.rooms`, `train.shards`, `train.furniture`, `more2_jax`.
"""
