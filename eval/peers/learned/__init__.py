"""Peers that learn: small forms of published networks, trained on the same clouds as ours, with weights in `weights/`.

May import `eval.peers.matching`, `eval.peers.registration`, `eval.peers.reconstruction`, `eval.peers.end_to_end`,
`train`, `more2_jax`.
"""
