"""One function over many scenes, in processes that stay alive: local ones, or actors of a Ray cluster.

`work_through` deals tasks out and tries a task again whose process was killed; `local` and `ray_cluster` are the two
kinds of processes. May import no other package of the library.
"""
