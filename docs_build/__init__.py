"""What makes the documentation from the code: reference pages, example pages, and the check of its prose.

`hooks.py` puts the generated pages into every docs build; none of them is kept in the repository.
May import `more2_jax`, `train`; programs of `eval` are asked for their help.
"""
