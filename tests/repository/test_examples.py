"""Every example runs by itself and finds what it claims; bounds are generous, the printed figures are the real ones."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys

import pytest
from places import ROOT

EXAMPLES = sorted((ROOT / "examples").glob("[0-9]*.py"))
LIMIT_S = 300  # a minute on two quiet cores; machines are not always quiet


@pytest.fixture(scope="session")
def printed(tmp_path_factory):
    """What an example prints, by its number; compiled programs are shared."""
    cache = os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(tmp_path_factory.mktemp("compiled"))
    away = tmp_path_factory.mktemp("away")

    def run(number: int) -> str:
        path = next(p for p in EXAMPLES if p.name.startswith(f"{number:02d}_"))
        settings = {"JAX_PLATFORMS": "cpu", "JAX_COMPILATION_CACHE_DIR": cache, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(
            [sys.executable, path],
            cwd=away,
            env=os.environ | settings,
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
        )
        assert done.returncode == 0, done.stderr[-2000:]
        assert words(done.stdout) == words(kept_output(path)), "python -m docs_build.examples"
        return done.stdout

    return run


def kept_output(path) -> str:
    """What the page of an example says that it prints."""
    return (path.parent / "outputs" / f"{path.stem}.txt").read_text(encoding="utf-8")


def words(text: str) -> list[str]:
    """The text without its figures, which differ in the last digits from machine to machine."""
    return re.sub(r"-?\d[\d.,]*(?:e[-+]?\d+)?", "#", text).replace("[", " ").replace("]", " ").split()


def number_after(words: str, text: str) -> float:
    """The number that follows the words."""
    found = re.search(re.escape(words) + r"\s*(-?[\d.]+(?:e[-+]?\d+)?)", text)
    assert found, f"{words!r} not in {text!r}"
    return float(found[1])


def test_examples_are_numbered_and_say_what_one_learns():
    assert [int(p.name[:2]) for p in EXAMPLES] == list(range(1, 8))
    for path in EXAMPLES:
        assert "You learn:" in (ast.get_docstring(ast.parse(path.read_text())) or ""), path.name


def test_the_short_scene_has_at_most_15_lines_of_code():
    text = (ROOT / "examples/02_living_scene_in_15_lines.py").read_text()
    code = text.split('"""')[2]
    assert len([line for line in code.splitlines() if line.strip()]) <= 15


@pytest.mark.slow
def test_a_chair_is_found_again(printed):
    text = printed(1)
    assert number_after("rotation error:", text) < 2
    assert number_after("position error:", text) < 2
    assert "converged: True" in text


@pytest.mark.slow
def test_a_scene_in_few_lines_names_what_came_and_went(printed):
    text = printed(2)
    assert "scan 0 to 1: 5 moved, 1 static, added object_007, removed object_003" in text


@pytest.mark.slow
def test_the_gradient_agrees_with_finite_differences(printed):
    assert number_after("relative difference:", printed(3)) < 1e-3


@pytest.mark.slow
def test_a_hundred_pairs_are_registered(printed):
    assert number_after("share below 5°:", printed(4)) > 0.7


@pytest.mark.slow
def test_a_mesh_from_one_view_is_closed_and_its_verdict_follows_from_its_figures(printed):
    text = printed(5)
    by_view = number_after("unseen surface to the nearest seen point:", text)
    by_mesh = number_after("unseen surface to the mesh:", text)
    assert "closed: True" in text
    assert ("tells more" in text) == (by_mesh < by_view)
    assert (
        number_after("mesh to the true surface:", text) < 20
    )  # centimeters: around the chair, if not its shape


@pytest.mark.slow
def test_a_later_scan_changes_no_earlier_pose(printed):
    text = printed(6)
    assert "found again: 7 of 7" in text
    assert "earlier poses unchanged: yes" in text


@pytest.mark.slow
def test_another_encoder_takes_the_place(printed):
    text = printed(7)
    assert number_after("matched by the own descriptor alone:", text) >= 4
    assert number_after("median rotation error of right matches:", text) < 5
