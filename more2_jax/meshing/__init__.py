"""The surface of one object (paper §3.4): the decoder's field, corrected where the surface was seen, as a mesh.

`extract` is marching cubes from coarse to fine; the others say where observed points, free space and floor put it.
May import `network`, `geometry`, `config`, `types`.
"""

from typing import TYPE_CHECKING

if not TYPE_CHECKING:  # where a checker must not believe that every name exists
    from more2_jax.renamed import names_of

    __getattr__ = names_of(__name__)
