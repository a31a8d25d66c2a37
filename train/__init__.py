"""Training: `prepare` makes shards, `synthesize` benchmark rooms, `prior` trains; folders hold what they are built of.

Not packaged with the library. May import `more2_jax`.
"""
