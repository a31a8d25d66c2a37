"""A new scan against the objects known so far: its frame, who is who in it, and what each object gains.

Turns scene records into observed and accumulated objects, and what the stages answer into records.
May import `matching`, `registration`, `network`, `geometry`, `config`, `types`, `freed_memory`.
"""

from typing import TYPE_CHECKING

if not TYPE_CHECKING:  # where a checker must not believe that every name exists
    from more2_jax.renamed import names_of

    __getattr__ = names_of(__name__)
