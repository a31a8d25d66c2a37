"""Meshes of many objects in one compiled program, for accelerators: the steps of `meshing` as pure functions of arrays.

Every function takes one object, padded to a fixed size; `mesh` maps them over a batch. NumPy's versions, one object at
a time, are faster on a CPU and are what these are tested against. May import `meshing`, `network`, `geometry`,
`config`, `types`.
"""
