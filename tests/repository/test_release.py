"""A release: wheel and sdist are built, the wheel is installed in a fresh environment, and `more2` works from it."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
import yaml
from places import ROOT

import more2_jax

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
LARGEST_MB = 12  # of the wheel
PACKAGED = (  # more than Python files
    "more2_jax/py.typed",
    "more2_jax/assets/scene.schema.json",
    "more2_jax/assets/log.schema.json",
    "more2_jax/assets/weights/small.npz",
    "more2_jax/assets/weights/small_2.npz",
    "more2_jax/assets/page/three.min.js",
    *(
        f"more2_jax/assets/demo/{name}"
        for name in ("scan_0.ply", "scan_1.ply", "scan_2.ply", "ground_truth.json")
    ),
)


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> dict[str, Path]:
    """Both files, by the suffix of their names."""
    out = tmp_path_factory.mktemp("dist")
    build = [sys.executable, "-m", "hatchling", "build", "-d", out]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True, timeout=120)
    return {path.suffix: path for path in out.iterdir()}


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory) -> Path:
    """The programs of a fresh environment with the wheel; what it depends on is that of the tests."""
    folder = tmp_path_factory.mktemp("fresh")
    venv.create(folder, symlinks=True)  # no pip: that of the tests installs into it
    programs = folder / "bin"
    install = [sys.executable, "-m", "pip", "--python", programs / "python", "install", "--quiet"]
    subprocess.run([*install, "--no-deps", "--no-index", built[".whl"]], check=True, timeout=120)
    (site,) = folder.glob("lib/python*/site-packages")
    (site / "dependencies.pth").write_text(
        "\n".join(p for p in sys.path if p.endswith("site-packages")) + "\n"
    )
    return programs


def ran(programs: Path, *words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """What `more2` does there, away from the repository."""
    clean = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    return subprocess.run(
        [programs / "more2", *words], cwd=cwd, env=clean, capture_output=True, text=True, timeout=600
    )


def python(programs: Path, code: str, cwd: Path) -> str:
    """What Python prints there."""
    clean = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        [programs / "python", "-c", code], cwd=cwd, env=clean, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_the_wheel_holds_the_library_and_its_data(built):
    with zipfile.ZipFile(built[".whl"]) as wheel:
        names = set(wheel.namelist())
    tracked = subprocess.run(
        ["git", "ls-files", "more2_jax"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert set(tracked.stdout.split()) <= names
    assert set(PACKAGED) <= names
    assert {name.split("/")[0] for name in names} == {
        "more2_jax",
        f"more2_jax-{more2_jax.__version__}.dist-info",
    }
    assert built[".whl"].stat().st_size < LARGEST_MB * 1_000_000


def test_the_sdist_builds_the_same_wheel(built, tmp_path):
    with tarfile.open(built[".gz"]) as archive:
        archive.extraction_filter = getattr(tarfile, "data_filter", None)  # Python 3.11.4 and later
        archive.extractall(tmp_path)
    (source,) = tmp_path.iterdir()
    assert {"README.md", "CHANGELOG.md", "CITATION.cff", "LICENSE"} <= {p.name for p in source.iterdir()}
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path / "again"]
    subprocess.run(build, cwd=source, check=True, capture_output=True, timeout=120)
    (again,) = (tmp_path / "again").iterdir()
    with zipfile.ZipFile(again) as one, zipfile.ZipFile(built[".whl"]) as other:
        assert {i.filename: i.CRC for i in one.infolist()} == {i.filename: i.CRC for i in other.infolist()}


def test_more2_works_from_the_wheel(installed, tmp_path):
    home = python(installed, "import more2_jax; print(more2_jax.__file__)", tmp_path)
    assert Path(home).is_relative_to(installed.parent)  # the installed copy, not the checkout
    told = ran(installed, "--version", cwd=tmp_path)
    assert (told.returncode, told.stdout, told.stderr) == (0, f"more2 {more2_jax.__version__}\n", "")
    checked = ran(installed, "doctor", "--json", cwd=tmp_path)
    assert checked.returncode == 0, checked.stdout + checked.stderr
    found = json.loads(checked.stdout)
    assert found["self_test"]["passed"] and found["problems"] == []
    assert found["self_test"]["equivariance"] > 0  # it was measured
    assert set(found["extras"]) == set(PROJECT["optional-dependencies"]) - {"dev"}
    assert found["extras"]["docs"]["mkdocs-material"]


def test_one_place_says_the_version():
    assert "version" in PROJECT["dynamic"] and "version" not in PROJECT
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == more2_jax.__version__
    log = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (.+)$", log, re.MULTILINE)[:2] == [
        "Unreleased",
        f"{more2_jax.__version__} (2026-11-25)",
    ]


def test_the_citation_names_the_paper_and_us():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert citation["authors"] == [{"name": a["name"]} for a in PROJECT["authors"]]
    paper = citation["preferred-citation"]
    assert [a["family-names"] for a in paper["authors"]] == ["Zhu", "Huang", "Schindler", "Armeni"]
    assert paper["year"] == 2024 and "CVPR" in paper["collection-title"]
    assert citation["license"] == PROJECT["license"]
