"""All observations of an object at once (paper §3.5): code and poses optimized jointly, or poses in a pose graph.

`joint` and `pose_graph` work on one object; `…_of_objects` take accumulated objects to one batch and back.
May import `meshing`, `registration`, `network`, `geometry`, `config`, `types`.
"""
