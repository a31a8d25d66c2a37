"""JAX on the CPU in full precision, shapes of every signature checked, and the smallest prior there is."""

import os
from contextlib import nullcontext

os.environ["JAX_PLATFORMS"] = "cpu"

import jax
import jaxtyping
import pytest
from checked_modules import checked_modules
from compiling import quickly
from jaxtyping import install_import_hook
from places import ROOT

# Before anything of more2_jax is imported: every call's shapes and dtypes are held against its annotations.
install_import_hook(checked_modules(), "beartype.beartype")
jax.config.update("jax_default_matmul_precision", "highest")

# One browser for all tests of the page; after the hook, for it imports more2_jax.
from page_browser import browser, common, opened, opener, report, said  # noqa: E402, F401


@pytest.fixture(scope="session")
def tiny_prior():
    """Random weights in the smallest configuration."""
    from more2_jax.config import load_config
    from more2_jax.network.prior import init_prior
    from train.run.settings import TrainingRun

    config = load_config(ROOT / "configs" / "tiny.yaml", TrainingRun).model
    return init_prior(config, jax.random.key(0), "tiny")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """Tests marked `quickly` compile so, their fixtures included."""
    with quickly() if item.get_closest_marker("quickly") else nullcontext():
        return (yield)


@pytest.fixture
def unchecked(monkeypatch):
    """Switches the check of annotations off, to see a public door refuse what does not fit by itself."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
