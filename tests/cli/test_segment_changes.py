"""`--segment changes`: what `run` and `add` read, and what they refuse in one line."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from boxes import box
from command_line import refused
from factories import living_scene

from more2_jax.cli.main import main
from more2_jax.config import preset
from more2_jax.scans.read_changed_scans import NOT_USED, read_changed_scans
from more2_jax.storage.scene_folder import save_scene
from more2_jax.types import Scan


def cloud(path: Path, at: float, unit_m: float = 1.0, **arrays: np.ndarray) -> Path:
    """A floor, two walls, and a box at a place, without instances."""
    rng = np.random.default_rng(0)
    planes = [([3, 3, 0], 12_000), ([0, 3, 2], 8000), ([3, 0, 2], 8000)]
    parts = [rng.uniform(0, 1, (count, 3)) * size for size, count in planes]
    points = np.concatenate([*parts, box(1, [0.6, 0.5, 0.6], [at, 1.5, 0.31], 3000)]) / unit_m
    np.savez(path, points=points, **arrays)
    return path


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    return cloud(tmp_path / "a.npz", 0.8), cloud(tmp_path / "b.npz", 2.2)


def test_reads_each_scan_with_the_box_that_moved(pair: tuple[Path, Path]):
    for scan, at in zip(read_changed_scans(pair), (0.8, 2.2), strict=True):
        (found,) = scan.instances
        assert np.abs(found.points.mean(axis=0)[0] - at) < 0.1
        assert any("changed between scans: 1" in w for w in scan.warnings)
        assert any("--masks" in w for w in scan.warnings)


def test_the_unit_scales_and_earlier_scans_are_only_compared_with(tmp_path: Path, pair: tuple[Path, Path]):
    in_mm = cloud(tmp_path / "mm.npz", 2.2, 0.001)
    earlier = cloud(tmp_path / "mm0.npz", 0.8, 0.001)
    (scan,) = read_changed_scans([in_mm], earlier=[earlier], unit="mm")
    meters = read_changed_scans(pair)[1]
    assert scan.name == "mm"
    assert [len(i.points) for i in scan.instances] == [len(i.points) for i in meters.instances]
    assert np.allclose(scan.instances[0].points, meters.instances[0].points, atol=1e-9)


def test_a_scan_with_instances_keeps_them(tmp_path: Path, pair: tuple[Path, Path]):
    instance = np.repeat([0, 7], [28_000, 3000])
    labeled = cloud(tmp_path / "labeled.npz", 0.8, instance=instance)
    first, second = read_changed_scans([labeled, pair[1]])
    assert [i.id for i in first.instances] == [7]
    assert NOT_USED in first.warnings
    assert [i.id for i in second.instances] == [1]


def test_run_hands_them_to_the_method(tmp_path: Path, capsys, monkeypatch, pair: tuple[Path, Path]):
    monkeypatch.setattr("more2_jax.network.prior.load_prior", lambda _: SimpleNamespace(name="tiny"))
    given = stop_at_stage(monkeypatch)
    line = refused_last(
        capsys, "run", *pair, "--out", tmp_path / "room", "--prior", "tiny", "--segment", "changes"
    )
    assert "enough" in line
    assert [[i.id for i in s.instances] for s in given] == [[1]]


def test_add_compares_with_the_last_scan(tmp_path: Path, capsys, monkeypatch, pair: tuple[Path, Path]):
    monkeypatch.setattr("more2_jax.network.prior.load_prior", lambda _: SimpleNamespace(name="tiny"))
    given = stop_at_stage(monkeypatch)
    out, stored = tmp_path / "room", replace(living_scene(), prior="tiny")
    scans = (*stored.scans[:-1], replace(stored.scans[-1], source=str(pair[0])))
    save_scene(replace(stored, scans=scans), out, preset("robust", upright=True))
    assert "enough" in refused_last(capsys, "add", out, pair[1], "--prior", "tiny", "--segment", "changes")
    (scan,) = given
    assert scan.name == "b"
    assert any("changed between scans: 1" in w for w in scan.warnings)
    pair[0].unlink()
    line = refused(capsys, "add", out, pair[1], "--prior", "tiny", "--segment", "changes")
    assert "its last scan was read from" in line and "--segment geometric" in line


def stop_at_stage(monkeypatch) -> list[Scan]:
    """The scans that reach the method, which then stops."""
    given = []

    def stage(*args, **options):
        given.extend(a for a in (*args, *options.values()) if isinstance(a, Scan))
        raise ValueError("enough")

    monkeypatch.setattr("more2_jax.scene.start_scene", stage)
    monkeypatch.setattr("more2_jax.scene.add_scan", stage)
    return given


def refused_last(capsys, *argv: object) -> str:
    """The last line of standard error of a command that must exit with 2; warnings come before it."""
    assert main([str(a) for a in argv]) == 2
    return capsys.readouterr().err.splitlines()[-1]


def test_one_scan_alone_is_refused(tmp_path: Path, capsys, pair: tuple[Path, Path]):
    out = ("--out", tmp_path / "room", "--segment", "changes")
    assert "needed two scans or more" in refused(capsys, "run", pair[0], *out)
    assert "read_changed_scans" in refused(capsys, "inspect", pair[0], "--segment", "changes")


def test_scans_of_two_rooms_are_cut_alone_and_the_command_says_so(
    tmp_path: Path, capsys, monkeypatch, pair: tuple[Path, Path]
):
    given, other = stop_at_stage(monkeypatch), tmp_path / "other.npz"
    np.savez(other, points=box(2, [0.5, 0.5, 0.5], [30, 0, 0], 5000))
    argv = ("run", pair[0], other, "--out", tmp_path / "room", "--segment", "changes")
    assert main([str(a) for a in argv]) == 2  # at the stage
    said = " ".join(capsys.readouterr().err.split())
    assert "does not lie on the other scans in any one pose, and is cut as by --segment geometric" in said
    assert given and given[0].instances


@pytest.mark.parametrize("command", ["run", "inspect"])
def test_without_masks_both_ways_are_offered(tmp_path: Path, capsys, pair: tuple[Path, Path], command: str):
    place = ("--out", tmp_path / "room") if command == "run" else ()
    line = refused(capsys, command, pair[0], *place)
    assert "--segment changes for two or more scans of one room" in line
    assert "--segment geometric for one alone" in line
