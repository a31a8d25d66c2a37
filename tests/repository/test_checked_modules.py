"""Every call into the library is checked against its annotations, in all tests."""

from importlib.util import find_spec

import jax.numpy as jnp
import pytest
from checked_modules import UNCHECKED, checked_modules, library_modules
from jaxtyping import TypeCheckError

from more2_jax.geometry.points import kabsch


def checks(module: str) -> bool:
    """Whether a module was, or would be, imported with checks: by its loader."""
    spec = find_spec(module)
    assert spec is not None
    return type(spec.loader).__module__.startswith("jaxtyping")


@pytest.mark.parametrize("module", library_modules())
def test_every_module_is_checked_but_for_those_with_a_reason(module):
    assert checks(module) == (module not in UNCHECKED)


def test_the_list_is_of_the_tree():
    assert set(UNCHECKED) < set(library_modules())
    assert len(checked_modules()) == len(library_modules()) - len(UNCHECKED) > 100
    assert "more2_jax.scans.formats.pcd" in checked_modules()


def test_a_wrong_shape_does_not_pass():
    with pytest.raises(TypeCheckError):
        kabsch(jnp.zeros((4, 2)), jnp.zeros((4, 2)), jnp.ones(4))
