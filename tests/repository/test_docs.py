"""The snippets of the documentation run as they stand."""

from __future__ import annotations

import re

import numpy as np
import pytest
from places import ROOT


def snippet(page: str) -> str:
    """The Python of a page."""
    return "\n".join(re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL))


@pytest.mark.slow
def test_the_gradient_example_gives_a_finite_gradient():
    names: dict[str, object] = {"__name__": "snippet"}
    exec(snippet("docs/guides/gradients.md"), names)
    gradient = np.asarray(names["gradient"])
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() > 0


def test_every_public_name_is_there():
    import more2_jax

    assert all(getattr(more2_jax, name) is not None for name in more2_jax.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = more2_jax.nonsense
