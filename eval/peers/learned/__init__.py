"""Peers that learn: small forms of published networks, trained on the same clouds as ours, with weights in `weights/`.

May import `eval.harness`, `train`, `more2_jax`, and the peers that learn nothing.
"""
