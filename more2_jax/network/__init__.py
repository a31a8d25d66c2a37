"""The prior (paper §3.1): SE(3)-equivariant encoder, signed-distance decoder, and their weights.

Layers, encoder, decoder, batches of embeddings; the published PyTorch checkpoint converted and held against ours.
May import `geometry`, `config`, `types`, `whole_file`.
"""
