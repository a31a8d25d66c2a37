"""Registration of one pair of clouds (paper §3.3): starting poses, then descent or surface alignment; vmapped outside.

`descent` is the paper's; `field` takes Gauss-Newton steps on both completed fields; `surface` aligns surfaces
point-to-plane. The last two start all round.
May import `network`, `geometry`, `config`, `types`.
"""

from typing import TYPE_CHECKING

if not TYPE_CHECKING:  # where a checker must not believe that every name exists
    from more2_jax.renamed import names_of

    __getattr__ = names_of(__name__)
