"""JAX on the CPU in full precision, shapes of every signature checked, and the smallest prior there is."""

import gc
import os
from contextlib import nullcontext
from pathlib import Path

os.environ["JAX_PLATFORMS"] = "cpu"

import jax
import jaxtyping
import pytest
from checked_modules import checked_modules
from compiling import compile_quickly, optimized
from jaxtyping import install_import_hook
from places import ROOT

compile_quickly()
# Tracing makes millions of objects that stay: looking through them all less often saves a seventh of it.
gc.set_threshold(50_000, 20, 50)
# Before anything of more2_jax is imported: every call's shapes and dtypes are held against its annotations.
install_import_hook(checked_modules(), "beartype.beartype")

# One browser for all tests of the page; after the hook, for it imports more2_jax.
from page_browser import browser, common, opened, opener, report, said  # noqa: E402, F401

MOST_MAPS = 20_000  # two files of tests add no more than another 30,000


@pytest.fixture(scope="session")
def tiny_prior():
    """Random weights in the smallest configuration."""
    from more2_jax.config import load_config
    from more2_jax.network.prior import init_prior
    from train.run.settings import TrainingRun

    config = load_config(ROOT / "configs" / "tiny.yaml", TrainingRun).model
    with optimized(False):  # whichever test asks first
        return init_prior(config, jax.random.key(0), "tiny")


def pytest_collection_modifyitems(items):
    """Lets what takes longest begin: no worker waits for it at the end."""
    items.sort(key=lambda item: item.get_closest_marker("begins") is None)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """Tests marked `optimized` compile so, their fixtures included."""
    with optimized() if item.get_closest_marker("optimized") else nullcontext():
        return (yield)


@pytest.fixture(autouse=True, scope="module")
def forgotten_programs():
    """Drops compiled programs between files where there are many.

    On CPUs each takes memory maps, of which Linux gives a process 65,530: beyond, compiling crashes.
    """
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_text().splitlines()) > MOST_MAPS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture
def unchecked(monkeypatch):
    """Switches the check of annotations off, to see a public door refuse what does not fit by itself."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
