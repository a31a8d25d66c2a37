"""What every evaluation shares: options, runs over scenes and their shards, stages in batches, tables and plots.

May import `eval.scores`, `eval.data`, `train.run`, `more2_jax`.
"""
