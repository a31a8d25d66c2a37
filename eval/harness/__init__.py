"""What the evaluation programs share: options, resumable runs, batches over scenes, results, tables and plots.

Imports eval.scores, eval.data and more2_jax.
"""
