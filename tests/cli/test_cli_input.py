"""Bad input on the command line: one line on standard error, exit code 2."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from command_line import boxes, refused, run_quickly, scan_file
from factories import living_scene

from more2_jax.cli import living_scenes as building
from more2_jax.cli.main import main
from more2_jax.cli.session import Session
from more2_jax.cli.settings import scene_config
from more2_jax.config import preset
from more2_jax.storage.scene_folder import load_scene, save_scene

pytestmark = pytest.mark.optimized  # scenes run for longer than their programs compile


def bad_scan(folder: Path, kind: str) -> Path:
    points, ids = boxes()
    path = folder / "scan.ply"
    if kind == "not a ply":
        path.write_bytes(b"\x89PNG\r\n")
    elif kind == "truncated":
        whole = scan_file(path).read_bytes()
        path.write_bytes(whole[: len(whole) // 2])
    elif kind == "no property":
        scan_file(path, name="segment")
    elif kind == "only background":
        scan_file(path, ids=np.zeros_like(ids))
    elif kind == "all too small":
        scan_file(path, points[:20], ids[:20])
    elif kind in ("nan", "inf"):
        points[17, 1] = float(kind)
        scan_file(path, points)
    return path


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("missing", "no such file"),
        ("not a ply", "not a PLY"),
        ("truncated", "truncated"),
        ("no property", "integer properties are segment"),
        ("only background", "no instances left"),
        ("all too small", "no instances left"),
        ("nan", "1 of 200 points have NaN or infinite"),
        ("inf", "1 of 200 points have NaN or infinite"),
    ],
)
@pytest.mark.parametrize("command", ["run", "inspect", "add"])
def test_bad_scans(tmp_path, stored, capsys, command, kind, message):
    path = bad_scan(tmp_path, kind)
    good = scan_file(tmp_path / "good.ply")
    argv = {
        "run": ["run", good, path, "--out", tmp_path / "new"],
        "inspect": ["inspect", path],
        "add": ["add", stored, path],
    }[command]
    assert message in refused(capsys, *argv)
    assert not (tmp_path / "new").exists()
    assert len(load_scene(stored)[0].scans) == 3


def test_small_objects_are_reported_and_the_rest_goes_on(tmp_path, capsys):
    points, ids = boxes()
    assert main(["inspect", str(scan_file(tmp_path / "a.ply", points[:130], ids[:130]))]) == 0
    told = capsys.readouterr()
    assert "1 instances" in told.out
    assert "ignored: instance 2 (30 points; needed 64)" in told.out


def test_run_names_skipped_objects_and_records_them(tmp_path, tiny, capsys):
    points, ids = boxes()
    a = scan_file(tmp_path / "a.ply", points[:130], ids[:130])
    assert run_quickly(a, out=tmp_path / "room", prior=tiny) == 0
    assert "skipped instance 2: 30 points; needed 64" in capsys.readouterr().out
    skipped = json.loads((tmp_path / "room/scene.json").read_text())["scans"][0]["skipped"]
    assert skipped == [{"what": "instance 2", "reason": "30 points; needed 64"}]


@pytest.mark.parametrize(("unit", "warned"), [("m", True), ("mm", False)])
def test_millimeters_are_warned_of_and_scaled(tmp_path, tiny, capsys, unit, warned):
    points, ids = boxes()
    a = scan_file(tmp_path / "a.ply", 1000 * points, ids)
    assert run_quickly(a, out=tmp_path / "room", prior=tiny, unit=unit) == 0
    warnings = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: ")]
    assert len(warnings) == warned
    assert all("pass --unit mm" in line for line in warnings)
    size = np.ptp(load_scene(tmp_path / "room")[0].objects[0].points, axis=0).max()
    assert size == pytest.approx(1000 if warned else 1, rel=0.1)


def test_the_same_warning_is_printed_once(capsys):
    session = Session()
    for _ in range(3):
        session.warn("odd\nsize")
    assert capsys.readouterr().err == "warning: odd size\n"
    assert session.text().count("odd size") == 1


def test_instance_property_is_taken_by_name(tmp_path, capsys):
    path = scan_file(tmp_path / "a.ply", name="segment")
    assert main(["inspect", str(path), "--instance-property", "segment"]) == 0
    assert "2 instances" in capsys.readouterr().out


def test_an_occupied_folder_is_refused_before_anything_is_read(tmp_path, capsys, monkeypatch):
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken/thesis.tex").write_text("years")
    monkeypatch.setattr(building, "read", lambda *args: pytest.fail("a scan was read"))
    line = refused(capsys, "run", "a.ply", "--out", tmp_path / "taken")
    assert "output folder not empty and not a living scene" in line
    assert (tmp_path / "taken/thesis.tex").read_text() == "years"


def test_scans_are_all_read_before_the_prior(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(
        "more2_jax.network.prior.load_prior", lambda name: pytest.fail("the prior was loaded")
    )
    refused(capsys, "run", scan_file(tmp_path / "a.ply"), tmp_path / "none.ply", "--out", tmp_path / "room")


def test_weights_of_another_shape(tmp_path, tiny, capsys):
    with np.load(tiny) as file:
        arrays = dict(file)
    name = next(k for k in arrays if k.endswith("kernel"))
    np.savez(tmp_path / "bad.npz", **arrays | {name: arrays[name][:-1]})
    scan, bad = scan_file(tmp_path / "a.ply"), tmp_path / "bad.npz"
    line = refused(capsys, "run", scan, "--out", tmp_path / "room", "--prior", bad)
    assert name in line
    assert "shape" in line


def test_unknown_prior(tmp_path, capsys):
    line = refused(
        capsys, "run", scan_file(tmp_path / "a.ply"), "--out", tmp_path / "room", "--prior", "huge"
    )
    assert "'huge'" in line


def test_no_scans(tmp_path, capsys):
    assert "no scans" in refused(capsys, "run", "--out", tmp_path / "room")


def test_add_needs_a_scene_and_its_own_prior(tmp_path, stored, tiny, capsys):
    scan = scan_file(tmp_path / "a.ply")
    assert "no living scene" in refused(capsys, "add", tmp_path / "nowhere", scan)
    assert "needs, 'small'" in refused(capsys, "add", stored, scan, "--prior", tiny)
    save_scene(dataclasses.replace(living_scene(), prior="mine"), tmp_path / "mine", preset("robust"))
    assert "not shipped; pass --prior" in refused(capsys, "add", tmp_path / "mine", scan)


@pytest.mark.parametrize(
    ("yaml", "message"),
    [
        ("joint: {stepz: 3}", "unknown stepz"),
        ("joint: {steps: many}", "joint.steps: got 'many', needed int"),
        ("joint: [", "not YAML"),
        ("joint: 3", "needed a mapping"),
        ("- 1", "needed a mapping"),
    ],
)
def test_bad_settings(tmp_path, capsys, yaml, message):
    (tmp_path / "s.yaml").write_text(yaml)
    line = refused(capsys, "run", "a.ply", "--out", tmp_path / "room", "--config", tmp_path / "s.yaml")
    assert message in line


def test_settings_replace_only_what_they_name(tmp_path):
    (tmp_path / "s.yaml").write_text("joint: {steps: 7}\nstatic_m: 0.2")
    config, base = scene_config("robust", True, tmp_path / "s.yaml"), preset("robust", upright=True)
    assert config == dataclasses.replace(base, static_m=0.2, joint=dataclasses.replace(base.joint, steps=7))


@pytest.mark.parametrize(
    "argv", [["run", "a.ply"], ["fly"], ["export", "room", "--format", "obj"], ["run", "--unit", "ft"]]
)
def test_usage_errors_exit_with_2(argv, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(argv)
    assert stopped.value.code == 2


def test_a_full_disk_is_a_failure_not_bad_input(tmp_path, stored, capsys, monkeypatch):
    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("more2_jax.export.export_scene", full)
    assert main(["export", str(stored), "--format", "json"]) == 1
    assert capsys.readouterr().err.splitlines() == ["error: [Errno 28] No space left on device"]
