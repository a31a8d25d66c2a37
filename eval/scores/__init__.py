"""Scores of one assignment, pose, mesh or track, and figures over many: denominators, failures, intervals.

May import `eval.data`, `train.furniture`, `more2_jax`.
"""
