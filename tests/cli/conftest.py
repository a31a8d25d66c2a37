"""Weights, cache and a stored scene for tests of the command line."""

from pathlib import Path

import pytest
from factories import living_scene

from more2_jax.config import preset
from more2_jax.network.prior import save_prior
from more2_jax.report import report_html
from more2_jax.storage.scene_folder import save_scene


@pytest.fixture(scope="session")
def tiny(tmp_path_factory, tiny_prior) -> Path:
    path = tmp_path_factory.mktemp("weights") / "tiny.npz"
    save_prior(tiny_prior, path)
    return path


@pytest.fixture(autouse=True)
def own_cache(monkeypatch, tmp_path_factory):
    monkeypatch.setenv("MORE2_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.fixture
def stored(tmp_path) -> Path:
    scene, config = living_scene(), preset("robust", upright=True)
    save_scene(scene, tmp_path / "room", config, page=report_html(scene, config))
    return tmp_path / "room"
