"""Refinement: poses of an object's observations made to agree (pose graph), or optimized with its code (paper §3.5).

`joint` and `pose_graph` are the algorithms on padded batches; `…_of_objects` takes records to them and back. May import
`config`, `types`, `geometry`, `network`, `tracking` and `meshing`.
"""
