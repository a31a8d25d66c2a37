"""Help, `more2 show`, `more2 export`, and where compiled programs are kept."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import refused

from more2_jax.cli import scenes, session
from more2_jax.cli.main import main
from more2_jax.cli.session import cache_folder

SCENES = ("demo", "run", "batch", "add", "inspect", "show", "export", "index", "find")
COMMANDS = (*SCENES, "doctor", *(f"prior {p}" for p in ("list", "info", "import", "check")))
ACTIONS = (
    *(f"building.{name}" for name in ("demo", "run_scans", "add")),
    "batch.run_batch",
    *(f"scenes.{name}" for name in ("inspect", "show", "export")),
    *(f"places.{name}" for name in ("index", "find")),
    "doctor.doctor",
    *(f"priors.{name}" for name in ("list_shipped", "info", "import_published", "check")),
)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example_that_parses(command, capsys, monkeypatch):
    with pytest.raises(SystemExit) as stopped:
        main([*command.split(), "--help"])
    assert stopped.value.code == 0
    text = capsys.readouterr().out
    example = next(line for line in text.splitlines() if line.startswith("Example: more2 "))
    assert example.startswith(f"Example: more2 {command}")
    called = []
    for name in ACTIONS:
        monkeypatch.setattr(f"more2_jax.cli.{name}", lambda *a, **k: called.append(a) or 0)
    assert main(example.split()[2:]) == 0
    assert len(called) == 1


def test_help_does_not_wait_for_jax():
    code = "import sys, more2_jax.cli.main\nassert not {'jax', 'numpy', 'trimesh'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_show_prints_the_page_and_opens_it_only_with_a_display(stored, capsys, monkeypatch):
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    monkeypatch.setattr(scenes, "has_display", lambda: False)
    assert main(["show", str(stored)]) == 0
    assert Path(capsys.readouterr().out.strip()) == stored / "report.html"
    assert opened == []
    monkeypatch.setattr(scenes, "has_display", lambda: True)
    assert main(["show", str(stored)]) == 0
    assert opened == [(stored / "report.html").as_uri()]
    assert main(["show", str(stored), "--no-open"]) == 0
    assert len(opened) == 1


def test_show_makes_the_page_that_a_save_from_python_left_out(stored, capsys):
    page = stored / "report.html"
    before = page.read_text(encoding="utf-8")
    page.unlink()
    assert main(["show", str(stored), "--no-open"]) == 0
    assert Path(capsys.readouterr().out.strip()) == page
    assert page.read_text(encoding="utf-8") == before


def test_show_without_a_scene(tmp_path, capsys):
    assert "no living scene" in refused(capsys, "show", tmp_path)


@pytest.mark.parametrize("format", ["glb", "ply", "json"])
def test_export_writes_beside_the_folder_or_where_told(tmp_path, stored, format, capsys):
    before = (stored / "scene.json").read_bytes()
    assert main(["export", str(stored), "--format", format]) == 0
    assert (tmp_path / f"room.{format}").is_file()
    assert main(["export", str(stored), "--format", format, "--out", str(stored)]) == 0
    assert (stored / f"export.{format}").is_file()
    assert (stored / "scene.json").read_bytes() == before
    assert str(stored / f"export.{format}") in capsys.readouterr().out


def test_cache_folder_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("MORE2_CACHE", str(tmp_path / "own"))
    assert cache_folder() == tmp_path / "own"
    monkeypatch.delenv("MORE2_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_folder() == tmp_path / "xdg/more2_jax"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    assert cache_folder() == tmp_path / ".cache/more2_jax"


@pytest.mark.parametrize(
    ("jaxlib", "given", "flags"),
    [
        ("0.10.2", None, "--xla_cpu_use_fusion_emitters=false"),
        ("0.10.2", "--xla_dump_to=x", "--xla_dump_to=x --xla_cpu_use_fusion_emitters=false"),
        ("0.10.2", "--xla_cpu_use_fusion_emitters=true", "--xla_cpu_use_fusion_emitters=true"),
        ("0.13.0", None, None),  # XLA ends the process at a flag that it does not know
    ],
)
def test_a_flag_of_the_compiler_is_added_where_it_is_known_and_not_given(monkeypatch, jaxlib, given, flags):
    monkeypatch.setenv("XLA_FLAGS", given or "")
    if given is None:
        monkeypatch.delenv("XLA_FLAGS")
    monkeypatch.setattr(session, "version", lambda package: {"jaxlib": jaxlib}[package])
    for _ in range(2):
        session.compile_sooner()
        assert os.environ.get("XLA_FLAGS") == flags


def test_a_command_compiles_with_that_flag(tmp_path):
    start = "import os; from more2_jax.cli import session; session.keep_compiled_programs(); import jax"
    command = f"{start}; print(jax.jit(lambda x: x + 1)(1), os.environ['XLA_FLAGS'])"
    clean = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    done = subprocess.run(
        [sys.executable, "-c", command], env=clean, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["2", "--xla_cpu_use_fusion_emitters=false"]
