"""Who is who between two scans (paper §3.2): scores or evidence for every pair, and one assignment over them.

`code_assignment` compares codes, as the paper does; `pair_evidence` aligns pairs and asks how well they fit.
May import `registration`, `network`, `geometry`, `config`, `types`.
"""

from typing import TYPE_CHECKING

if not TYPE_CHECKING:  # where a checker must not believe that every name exists
    from more2_jax.renamed import names_of

    __getattr__ = names_of(__name__)
