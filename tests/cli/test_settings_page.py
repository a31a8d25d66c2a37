"""The page of settings is what the code says, and says something of every setting."""

import dataclasses

import pytest

from more2_jax.cli.main import main
from more2_jax.cli.settings_page import meanings_of, settings_page
from more2_jax.config import SceneConfig, preset


def classes(settings):
    """The classes of some settings and of all within them."""
    inner = [getattr(settings, f.name) for f in dataclasses.fields(settings)]
    return {type(settings)}.union(*(classes(x) for x in inner if dataclasses.is_dataclass(x)))


@pytest.mark.parametrize("name", ["robust", "paper"])
def test_every_setting_has_a_meaning(name):
    for settings in classes(preset(name)):
        meanings = meanings_of(settings)
        fields = [f for f in dataclasses.fields(settings) if not dataclasses.is_dataclass(f.default)]
        silent = [f.name for f in fields if not meanings[f.name] and f.default_factory is dataclasses.MISSING]
        assert silent == [], settings.__name__


def test_the_command_prints_it(capsys):
    assert main(["settings", "--preset", "paper"]) == 0
    said = capsys.readouterr().out
    assert said == settings_page(preset("paper")) and "| `registration.steps` | 200 |" in said
    assert "search" not in said  # nothing of an algorithm that the preset does not use


def test_values_are_those_of_the_settings():
    changed = dataclasses.replace(SceneConfig(), static_m=0.125)
    assert "| `static_m` | 0.125 |" in settings_page(changed)
