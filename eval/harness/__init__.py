"""What every evaluation shares: options, resumable runs over scenes, stages in batches, tables and plots.

May import `eval.scores`, `eval.data`, `more2_jax`.
"""
