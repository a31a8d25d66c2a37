"""The command line `more2 …`: `main` has a class a command, the others what the commands do.

Nothing here computes: commands read scans, call `scene`, store, and say what they did. JAX loads only when needed.
May import every other package and module of the library.
"""

import os
from typing import TYPE_CHECKING

# Before NumPy is imported. Matrices are small here: threads of one product wait for one another, which on a busy
# machine costs more than the product (docs/developing/notebook/speed_same_scene.md).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

if not TYPE_CHECKING:  # where a checker must not believe that every name exists
    from more2_jax.renamed import names_of

    __getattr__ = names_of(__name__)
