"""What the import contracts of pyproject.toml cannot say: short files, true docstrings, stages without files.

`lint-imports`, run by `.ci/run`, checks the layers themselves.
"""

import ast
import re
import tomllib
from pathlib import Path

import grimp
import pytest
from places import ROOT

LIBRARY = ROOT / "more2_jax"
PACKAGES = ("more2_jax", "train", "eval", "docs_build")
LONGEST_FILE, LONGEST_FUNCTION = 400, 40  # lines
STAGES = ("geometry", "network", "registration", "matching", "tracking", "meshing", "refinement")
# Weights are files: these alone read and write any.
READ_WEIGHTS = {f"more2_jax.network.{m}" for m in ("prior", "torch_checkpoint", "parity")}
# What is kept of scans and objects; stages below tracking take observed or accumulated objects.
SCENE_RECORDS = {"SceneObject", "ScanRecord", "LivingScene"}
FILE_NAMES = {"open", "Path", "pathlib", "io", "shutil", "tempfile"}

SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]
ALL_FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
STAGE_FILES = [path for stage in STAGES for path in sorted((LIBRARY / stage).rglob("*.py"))]
INITS = [path for path in ALL_FILES if path.name == "__init__.py"]


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def used_names(source: str) -> set[str]:
    """Names that a module reads, what it imports, and from where."""
    tree = ast.parse(source)
    names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    homes = {node.module for node in imports if isinstance(node, ast.ImportFrom) and node.module}
    return names | homes | {alias.name for node in imports for alias in node.names}


@pytest.fixture(scope="session")
def graph() -> grimp.ImportGraph:
    return grimp.build_graph(*PACKAGES, cache_dir=None)


def test_there_is_something_to_check(graph):
    assert len(ALL_FILES) > 150
    assert len(INITS) > 20
    assert "more2_jax.network.prior" in graph.find_modules_directly_imported_by("more2_jax.scene")


def test_every_package_of_the_library_is_a_layer():
    house = next(c for c in SETTINGS["importlinter"]["contracts"] if c.get("id") == "house")
    listed = {name.strip() for layer in house["layers"] for name in layer.split("|")}
    parts = {p.stem for p in LIBRARY.iterdir() if p.suffix == ".py" or (p / "__init__.py").is_file()}
    assert listed == parts - {"__init__"}
    assert set(STAGES) <= listed


@pytest.mark.parametrize("path", [*STAGE_FILES, LIBRARY / "scene.py", LIBRARY / "types.py"], ids=name_of)
def test_stages_know_no_files(path):
    known = used_names(path.read_text(encoding="utf-8")) & FILE_NAMES
    assert bool(known) == (module_of(path) in READ_WEIGHTS), known


@pytest.mark.parametrize(
    "source", ["open('a')", "from pathlib import Path", "import io", "from io import BytesIO"]
)
def test_the_use_of_files_is_noticed(source):
    assert used_names(source) & FILE_NAMES


@pytest.mark.parametrize("path", INITS, ids=name_of)
def test_a_package_says_what_lives_there_and_imports_no_more_than_it_says(path, graph):
    package, words = module_of(path), ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
    assert words
    assert len(words.splitlines()) <= 6
    if package == "more2_jax":
        return  # it imports nothing until a name is asked for
    inside = {m for m in graph.modules if f"{m}.".startswith(f"{package}.")}
    imported = set().union(*(graph.find_modules_directly_imported_by(m) for m in inside)) - inside
    allowed = tuple(f"{name}." for name in allowed_by(words, package))
    assert {m for m in imported - ALWAYS if not f"{m}.".startswith(allowed)} == set()


ALWAYS = {"more2_jax.renamed"}  # former names, for one release


def allowed_by(words: str, package: str) -> list[str]:
    """The packages and modules that a package's docstring lets it import; names of the library without its own."""
    said = re.search(r"May import (.*?)\.(?:\s|$)", words, re.DOTALL)
    assert said, f"{package}: no 'May import …'"
    if said[1] == "every other package and module of the library":
        return ["more2_jax"]
    names = re.findall(r"`([\w.]+)`", said[1])
    return [n if n.split(".")[0] in PACKAGES else f"more2_jax.{n}" for n in names]


@pytest.mark.parametrize("path", ALL_FILES, ids=name_of)
def test_files_and_functions_are_short(path):
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= LONGEST_FILE
    functions = [
        n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    lengths = {n.name: (n.end_lineno or n.lineno) - n.lineno + 1 for n in functions}
    assert {name: lines for name, lines in lengths.items() if lines > LONGEST_FUNCTION} == {}


@pytest.mark.parametrize("path", ALL_FILES, ids=name_of)
def test_modules_say_what_they_are(path):
    words = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    assert len(words) > 10
    assert "TODO" not in words


@pytest.mark.parametrize("path", [p for p in STAGE_FILES if p.parent.name != "tracking"], ids=name_of)
def test_only_tracking_knows_the_records_of_a_scene(path):
    assert used_names(path.read_text(encoding="utf-8")) & SCENE_RECORDS == set()


@pytest.mark.parametrize("path", sorted((ROOT / "eval" / "harness").rglob("*.py")), ids=name_of)
def test_evaluation_forges_no_records_to_call_a_stage(path):
    called = {
        node.func.id
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    assert called & (SCENE_RECORDS | {"record", "new_object", "seen_again"}) == set()


def test_no_drawer_for_odds_and_ends():
    assert not {p.stem for p in ALL_FILES} & {"utils", "util", "helpers", "misc", "common"}


def test_only_the_library_is_packaged():
    assert SETTINGS["hatch"]["build"]["targets"]["wheel"]["packages"] == ["more2_jax"]


@pytest.mark.parametrize("path", [*ALL_FILES, *sorted((ROOT / "configs").rglob("*.yaml"))], ids=name_of)
def test_no_absolute_paths(path):
    text = path.read_text(encoding="utf-8")
    assert re.findall(r"(?<![\w.<])/(?:home|root|work|Users|mnt|tmp|opt|var)/", text) == []
