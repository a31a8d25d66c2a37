"""What a user would pick instead: classical and learned peers of matching, registration, reconstruction.

May import `eval.harness`, `eval.scores`, `train`, `more2_jax`.
"""
