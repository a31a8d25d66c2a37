"""`more2 run | add | demo` from outside: what they print and leave on disk."""

import dataclasses
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import boxes, heed_interrupts, run_quickly, scan_file
from factories import living_scene
from rich.table import Table

from more2_jax.cli import living_scenes as building
from more2_jax.cli.main import main
from more2_jax.config import preset
from more2_jax.report import report_html, upright_text
from more2_jax.storage.scene_folder import load_scene, save_scene

pytestmark = pytest.mark.optimized  # scenes run for longer than their programs compile


def test_run_then_add(tmp_path, tiny, capsys):
    kinds = (("a", 0, 2), ("b", 0.3, 2), ("c", 0, 3))
    a, b, c = (scan_file(tmp_path / f"{name}.ply", *boxes(shift, count)) for name, shift, count in kinds)
    out = tmp_path / "room"
    assert run_quickly(a, b, out=out, prior=tiny) == 0
    told = capsys.readouterr().out
    assert "2 instances" in told
    assert str(out) in told
    scene, config = load_scene(out)
    assert [s.name for s in scene.scans] == ["a", "b"]
    assert (scene.preset, scene.prior, config.joint.steps, config.matching.method) == (
        "robust",
        "tiny",
        2,
        "evidence",
    )
    assert "meshing the scene: 2 objects" in (out / "run.log").read_text()
    assert (out / "report.html").read_text(encoding="utf-8") == report_html(scene, config)
    assert main(["add", str(out), str(c), "--prior", str(tiny)]) == 0
    added, again = load_scene(out)
    assert [s.name for s in added.scans] == ["a", "b", "c"]
    assert again == config
    assert (out / "report.html").read_text(encoding="utf-8") == report_html(added, again)
    assert added.objects[0].id == scene.objects[0].id
    assert sum(len(o.observations) for o in added.objects) == 7
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_demo_runs_on_the_bundled_scans_and_ends_with_the_truth(tmp_path, capsys, monkeypatch):
    asked = []
    monkeypatch.setattr(building, "run_scans", lambda *args, **_: asked.append(args) or living_scene())
    monkeypatch.setattr(
        "more2_jax.cli.demo_score.demo_table", lambda scene: (Table("truth"), f"{len(scene.objects)} right")
    )
    monkeypatch.chdir(tmp_path)
    assert main(["demo"]) == 0
    ((paths, out, config, prior),) = asked
    assert (len(paths), out, prior) == (3, Path("demo_scene"), "small")
    assert all(path.is_file() for path in paths)
    assert config == preset("robust", upright=True)
    assert capsys.readouterr().out.splitlines()[-1] == "5 right"


@pytest.mark.parametrize(
    ("option", "upright"), [([], None), (["--upright"], True), (["--any-orientation"], False)]
)
def test_the_first_scan_says_how_objects_move_unless_the_user_does(tmp_path, monkeypatch, option, upright):
    asked = []
    monkeypatch.setattr(building, "run_scans", lambda *args, **_: asked.append(args))
    assert main(["run", "a.ply", "b.ply", "--out", str(tmp_path / "room"), *option]) == 0
    assert asked[0][2] == preset("robust", upright=upright)


@pytest.mark.parametrize(
    ("upright", "likely_up", "says"),
    [
        (True, "+z", "a shows a level floor: objects stay upright (--any-orientation if they do not)"),
        (
            False,
            None,
            "a shows no floor across z: objects may turn in any way (--upright if z is up and they do not)",
        ),
        (False, "+y", "a: +y is likely up, not z: objects may turn in any way (--up y if they do not)"),
        (False, "-z", "a: -z is likely up, not z: objects may turn in any way (--up -z if they do not)"),
    ],
)
def test_what_was_settled_is_said_with_the_way_out(upright, likely_up, says):
    assert upright_text("a", upright, likely_up) == says


@pytest.mark.parametrize(("option", "repaired"), [([], True), (["--keep-masks"], False)])
def test_keep_masks_turns_their_repair_off(tmp_path, monkeypatch, option, repaired):
    asked = []
    monkeypatch.setattr(building, "run_scans", lambda *args, **_: asked.append(args))
    assert main(["run", "a.ply", "b.ply", "--out", str(tmp_path / "room"), *option]) == 0
    config = asked[0][2]
    assert config == dataclasses.replace(preset("robust"), repair_masks=repaired)


def test_one_scan_is_reconstructed_without_changes(tmp_path, tiny, capsys):
    a = scan_file(tmp_path / "a.ply")
    assert run_quickly(a, out=tmp_path / "room", prior=tiny) == 0
    scene, _ = load_scene(tmp_path / "room")
    assert scene.changes == ()
    assert [o.mesh is not None for o in scene.objects] == [True, True]


def test_ctrl_c_leaves_nothing_and_exits_with_130(tmp_path, tiny, capsys, monkeypatch):
    def interrupted(*args, **_):
        raise KeyboardInterrupt

    monkeypatch.setattr("more2_jax.scene.start_scene", interrupted)
    a = scan_file(tmp_path / "a.ply")
    assert main(["run", str(a), "--out", str(tmp_path / "room"), "--prior", str(tiny)]) == 130
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]


def test_ctrl_c_while_writing_leaves_the_old_scene(tmp_path, stored, monkeypatch):
    def interrupted(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr("more2_jax.storage.scene_folder.to_yaml", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save_scene(dataclasses.replace(living_scene(), prior="newer"), stored, preset("robust"))
    assert load_scene(stored)[0].prior == "small"
    assert [p.name for p in tmp_path.iterdir()] == ["room"]


@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT")
def test_sigint_to_the_process_exits_with_130(tmp_path, tiny):
    code = (
        "import sys, time, more2_jax.cli.living_scenes as s; from more2_jax.cli.main import main\n"
        "s.read = lambda *a: (print('waiting', flush=True), time.sleep(60))\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    argv = [sys.executable, "-c", code, "run", "a.ply", "--out", str(tmp_path / "room"), "--prior", str(tiny)]
    with subprocess.Popen(
        argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heed_interrupts
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "waiting\n"
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=30)
    assert (process.returncode, err) == (130, "interrupted\n")
    assert not (tmp_path / "room").exists()
