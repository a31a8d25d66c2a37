"""Rigid poses, clouds and padding: geometry without a network, the same for every stage.

Poses, floors and outliers on the host; sampling, nearest points, ICP, SE(3) descent and free space on the device.
May import `config`, `types`.
"""

from typing import TYPE_CHECKING

if not TYPE_CHECKING:  # where a checker must not believe that every name exists
    from more2_jax.renamed import names_of

    __getattr__ = names_of(__name__)
