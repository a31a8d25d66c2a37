"""The pages of architecture and of adding a part are true: the drawing, the walk, and the places they name."""

import ast
import re
import tomllib

import pytest
from places import ROOT

DEVELOPING = ROOT / "docs" / "developing"
PAGE = (DEVELOPING / "architecture.md").read_text(encoding="utf-8")
ADVICE = (DEVELOPING / "adding.md").read_text(encoding="utf-8")
CONTRACTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
LAYER = re.compile(r"^│ (\w+(?: \| \w+)*) {2,}\S", re.MULTILINE)


def walk() -> list[tuple[str, str]]:
    """Function and file of every step, as the page's table has them."""
    rows = re.findall(r"^\| [^|]+ \| (`\w+`(?:, `\w+`)*) \| `([\w/]+\.py)` \|", PAGE, re.MULTILINE)
    return [(name, file) for names, file in rows for name in re.findall(r"\w+", names)]


def test_the_drawing_shows_the_layers_of_the_contract():
    house = next(c for c in CONTRACTS if c.get("id") == "house")
    assert LAYER.findall(PAGE) == house["layers"]
    first = CONTRACTS[0]["layers"]
    assert " ──────▶ ".join(first) in PAGE


def test_the_walk_is_long_enough_to_reach_the_page():
    assert len(walk()) == 33
    assert {"read_scan", "add_scan", "save_scene", "report_html"} <= {name for name, _ in walk()}


@pytest.mark.parametrize(("name", "file"), walk())
def test_a_step_of_the_walk_is_a_function_of_its_file(name, file):
    tree = ast.parse((ROOT / "more2_jax" / file).read_text(encoding="utf-8"))
    assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_the_walk_goes_in_the_order_of_the_scene():
    """What `add_scan` and `reconstruct` call stands in the page in the order in which they call it."""
    scene = (ROOT / "more2_jax/scene.py").read_text(encoding="utf-8")
    body = scene[scene.index("def who_is_who") : scene.index("def usable")]
    named = [name for name, file in walk() if file != "scene.py" and f"{name}(" in body]
    assert len(named) > 8
    assert named == sorted(named, key=lambda name: body.index(f"{name}("))


@pytest.mark.parametrize("text", [PAGE, ADVICE], ids=["architecture", "adding"])
def test_places_that_are_named_exist(text):
    named = set(re.findall(r"`((?:more2_jax|tests|eval|train)/[\w/.]+)`", text))
    assert {p for p in named if not (ROOT / p).exists()} == set()


@pytest.mark.parametrize("part", ["reader", "matcher", "registration", "metric"])
def test_a_part_takes_three_files_and_names_its_test(part):
    (section,) = re.findall(rf"^## An? {part}\b.*?(?=^## |\Z)", ADVICE, re.DOTALL | re.MULTILINE)
    steps = re.findall(r"^(\d)\. (.*)", section, re.MULTILINE)
    assert [number for number, _ in steps] == ["1", "2", "3"]
    assert steps[2][1].startswith("`tests/")
    (command,) = re.findall(r"Must pass: `pytest ([^`]+)`", section)
    assert all((ROOT / path).exists() for path in command.split())


def test_both_pages_are_linked():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert "docs/developing/architecture.md" in readme
    assert "CONTRIBUTING.md" in readme
    assert "docs/developing/adding.md" in (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
