"""Evaluation: a program a question (`python -m eval.end_to_end …`); folders hold what programs are built of.

Not packaged with the library. May import `train`, `more2_jax`.
"""
