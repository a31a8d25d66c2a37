"""What one would use instead of this package, on the same clouds, and learned peers of the decoder.

Needs the extra `peers`. Imports eval.harness, eval.scores, train.run, train.shards and more2_jax.
"""
