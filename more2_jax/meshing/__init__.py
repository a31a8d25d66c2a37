"""Meshes: iso-surface extraction from a code, corrected where points were observed (paper §3.4).

Holds the grids, the observed surface, its planes and their orientation, and the mesh of a scene's object. May import
`config`, `types`, `geometry`, `network` and `tracking`.
"""
