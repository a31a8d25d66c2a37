"""The shape of the house: imports point down, files and functions stay short, only the library is packaged."""

import ast
import graphlib
import re
import tomllib
from pathlib import Path

import pytest
from places import ROOT

LIBRARY = ROOT / "more2_jax"
LONGEST_FILE, LONGEST_FUNCTION = 400, 40  # lines

# Low to high; a module imports from its own layer or those before it. `data.*` and `commands.*` are folders.
LAYERS = {
    "types": ("types", "config", "progress"),
    "tools": (
        "geometry",
        "nearest_grid",
        "sight",
        "batching",
        "descent",
        "metrics",
        "meshfile",
        "color",
        "data",
    ),
    "network": (
        "vn",
        "neighbors",
        "encoder",
        "local_field",
        "decoder",
        "prior",
        "in_turn",
        "losses",
        "published",
        "checkpoint",
    ),
    "stages": (
        "alignment",
        "starts",
        "matching",
        "surface_registration",
        "pose_graph",
        "evidence",
        "registration",
        "orientation",
        "outliers",
        "lattice",
        "planes",
        "screened_poisson",
        "seen_surface",
        "meshing",
        "joint",
    ),
    "scene": (
        "objects",
        "sights",
        "encoding",
        "verification",
        "consensus",
        "frames",
        "tracking",
        "fitting",
        "closing",
        "scene",
    ),
    "programs": ("io", "report", "export", "demo", "commands", "cli", "train", "eval"),
}
HEIGHT = {name: height for height, names in enumerate(LAYERS.values()) for name in names}

LIBRARY_FILES = sorted(LIBRARY.rglob("*.py"))
PROGRAM_FILES = sorted(path for folder in ("train", "eval") for path in (ROOT / folder).rglob("*.py"))
ALL_FILES = [*LIBRARY_FILES, *PROGRAM_FILES]


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def module_of(path: Path) -> str:
    """Dotted name below more2_jax for the library, from the root for programs."""
    base = LIBRARY if path.is_relative_to(LIBRARY) else ROOT
    return ".".join(path.relative_to(base).with_suffix("").parts).removesuffix(".__init__")


def imports_of(path: Path) -> set[str]:
    """Modules of more2_jax that a file imports anywhere, also inside functions."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name_of(path)}:{node.lineno}: relative import"
            names = (
                [f"{node.module}.{a.name}" for a in node.names] if node.module in PACKAGES else [node.module]
            )
        elif isinstance(node, ast.Import):
            names = [a.name for a in node.names]
        else:
            continue
        found |= {n.removeprefix("more2_jax.") for n in names if n and n.startswith("more2_jax.")}
    return found


PACKAGES = {"more2_jax", "more2_jax.data", "more2_jax.commands"}
INNER = [p for p in ALL_FILES if p != LIBRARY / "__init__.py"]  # which only re-exports


def test_there_is_something_to_check():
    assert len(LIBRARY_FILES) > 20
    assert imports_of(LIBRARY / "registration.py") >= {"config", "prior", "geometry", "types"}


def test_every_module_has_a_layer():
    assert {module_of(p).split(".")[0] for p in INNER} <= set(HEIGHT)


@pytest.mark.parametrize("path", INNER, ids=name_of)
def test_imports_point_down(path):
    mine = HEIGHT[module_of(path).split(".")[0]]
    up = sorted(name for name in imports_of(path) if HEIGHT[name.split(".")[0]] > mine)
    assert up == []


def test_no_import_cycles():
    graph = {module_of(p): imports_of(p) for p in INNER}
    assert len(tuple(graphlib.TopologicalSorter(graph).static_order())) >= len(graph)


@pytest.mark.parametrize("stage", LAYERS["stages"])
def test_stages_know_no_files(stage):
    tree = ast.parse((LIBRARY / f"{stage}.py").read_text())
    names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    modules = {a.name for n in ast.walk(tree) if isinstance(n, ast.Import | ast.ImportFrom) for a in n.names}
    assert not (names | modules) & {"open", "Path", "pathlib", "os"}


@pytest.mark.parametrize("path", ALL_FILES, ids=name_of)
def test_files_and_functions_are_short(path):
    text = path.read_text()
    assert len(text.splitlines()) <= LONGEST_FILE
    long = {
        node.name: node.end_lineno - node.lineno + 1
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and node.end_lineno - node.lineno >= LONGEST_FUNCTION
    }
    assert long == {}


def test_no_drawer_for_odds_and_ends():
    assert not {p.stem for p in ALL_FILES} & {"utils", "util", "helpers", "misc", "common"}


def test_only_the_library_is_packaged():
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]
    assert build["wheel"]["packages"] == ["more2_jax"]


@pytest.mark.parametrize("path", [*ALL_FILES, *sorted((ROOT / "configs").glob("*.yaml"))], ids=name_of)
def test_no_absolute_paths(path):
    assert re.findall(r"(?<![\w.<])/(?:home|root|work|Users|mnt|tmp|opt|var)/", path.read_text()) == []
