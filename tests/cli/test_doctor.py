"""`more2 doctor`, `more2 completion`, `more2 --version`. tests/repository/test_release.py runs the self-test itself."""

import json
import shutil
import subprocess
from dataclasses import replace

import pytest

import more2_jax
from more2_jax.cli import doctor
from more2_jax.cli.main import main
from more2_jax.cli.self_test import MOST_DEVIATION, MOST_POSITION_M, MOST_ROTATION_DEG, SelfTest

GOOD = SelfTest(equivariance=1e-6, rotation_error_deg=0.4, position_error_m=0.004, seconds=9.0)


@pytest.fixture
def healthy(monkeypatch):
    monkeypatch.setattr(doctor, "self_test", lambda: GOOD)


def test_it_says_what_is_there(healthy, capsys):
    assert main(["doctor", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["more2"] == more2_jax.__version__
    assert told["devices"][0].startswith("cpu:0")
    assert told["free_memory_mb"] is None or told["free_memory_mb"] > 0
    assert told["self_test"]["passed"] is True
    assert told["problems"] == []
    assert main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"more2      {more2_jax.__version__}")
    assert lines[-1] == "all is well"


def test_extras_name_their_packages_and_what_is_missing(monkeypatch):
    needs = (
        'trimesh>=4\nRequires-Dist: embreex>=4.4; extra == "data"\n'
        'Requires-Dist: no-such-thing[x]>=1; extra == "data"\n'
        'Requires-Dist: more2-jax[data]; extra == "train"\nRequires-Dist: numpy>=2; extra == "train"\n'
        'Requires-Dist: pytest; extra == "dev"'
    )
    head = "Metadata-Version: 2.4\nName: more2-jax\nVersion: 0\nProvides-Extra: data\nProvides-Extra: train\n"
    text = f"{head}Provides-Extra: dev\nRequires-Dist: {needs}\n"
    parsed = doctor.metadata.PathDistribution  # the parser of installed packages

    class Told(parsed):
        def __init__(self):
            pass

        def read_text(self, filename):
            return text if filename == "METADATA" else None

    monkeypatch.setattr(doctor.metadata, "metadata", lambda name: Told().metadata)
    found = doctor.extras()
    assert set(found) == {"data", "train"}
    assert found["data"]["no-such-thing"] is None
    assert set(found["train"]) == {"embreex", "no-such-thing", "numpy"}
    assert found["train"]["numpy"] == doctor.metadata.version("numpy")


def test_a_cache_that_cannot_be_written_is_a_problem(healthy, monkeypatch, tmp_path, capsys):
    (tmp_path / "file").write_text("in the way")
    assert doctor.is_writable(str(tmp_path / "new" / "folder"))
    assert not doctor.is_writable(str(tmp_path / "file" / "folder"))
    monkeypatch.setattr(doctor, "is_writable", lambda folder: False)
    assert main(["doctor"]) == 1
    assert "problem    cache" in capsys.readouterr().out


@pytest.mark.parametrize(
    "bad",
    [
        {"equivariance": 2 * MOST_DEVIATION},
        {"rotation_error_deg": 2 * MOST_ROTATION_DEG},
        {"position_error_m": 2 * MOST_POSITION_M},
        {"equivariance": float("nan")},
    ],
)
def test_other_numbers_are_a_problem(monkeypatch, capsys, bad):
    assert GOOD.passed
    monkeypatch.setattr(doctor, "self_test", lambda: replace(GOOD, **bad))
    assert main(["doctor", "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["self_test"]["passed"] is False
    assert len(told["problems"]) == 1


def test_a_self_test_that_breaks_is_told_in_one_line(monkeypatch, capsys):
    def broken():
        raise RuntimeError("no such\ndevice")

    monkeypatch.setattr(doctor, "self_test", broken)
    assert main(["doctor"]) == 1
    assert "problem    the self-test failed: RuntimeError: no such device" in capsys.readouterr().out


def test_free_memory_is_read_where_the_system_says(monkeypatch, tmp_path):
    monkeypatch.setattr(doctor, "MEMORY", tmp_path / "meminfo")
    assert doctor.free_memory_mb() is None
    doctor.MEMORY.write_text("MemTotal:       16000000 kB\nMemAvailable:    2097152 kB\n")
    assert doctor.free_memory_mb() == 2048


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"more2 {more2_jax.__version__}\n"


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_is_a_script_that_knows_every_command(shell, capsys, tmp_path):
    with pytest.raises(SystemExit) as ended:
        main(["completion", shell])
    assert not ended.value.code
    script = capsys.readouterr().out
    assert all(word in script for word in ("more2", "inspect", "keep-masks", "prior", "doctor"))
    if shutil.which(shell):
        (tmp_path / "script").write_text(script)
        subprocess.run([shell, "-n", tmp_path / "script"], check=True)
