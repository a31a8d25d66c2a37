"""A run that is stopped leaves the scans so far, and the same command with --resume ends as if it had not been."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import FEW_STEPS, boxes, heed_interrupts, refused, run_quickly, scan_file

from more2_jax.cli import living_scenes as building
from more2_jax.cli.main import main
from more2_jax.network.prior import load_prior, save_prior
from more2_jax.storage.scene_folder import load_scene
from more2_jax.storage.waiting_meshes import WaitingMeshes

pytestmark = pytest.mark.optimized  # scenes run for longer than their programs compile

POSIX = pytest.mark.skipif(os.name != "posix", reason="sends signals")
# Stops at a named place, says so, and waits there to be sent a signal.
STOPPING = """
import sys, time
import more2_jax.scene, more2_jax.storage.scene_folder, more2_jax.meshing.object_mesh
from more2_jax.cli.main import main

def stop(module, name, nth):
    real, calls = getattr(module, name), [0]
    def wrapped(*args, **kwargs):
        calls[0] += 1
        if calls[0] == nth:
            print("here", flush=True)
            time.sleep(10)  # meshes are made by other threads, which no signal wakes
        return real(*args, **kwargs)
    setattr(module, name, wrapped)

place, nth = sys.argv[1], int(sys.argv[2])
module = {"add_scan": more2_jax.scene, "reconstruct": more2_jax.scene, "object_mesh": more2_jax.meshing.object_mesh}
stop(module.get(place, more2_jax.storage.scene_folder), place, nth)
sys.exit(main(sys.argv[3:]))
"""


@pytest.fixture
def three(tmp_path) -> list[Path]:
    kinds = (("a", 0, 2), ("b", 0.3, 2), ("c", 0, 3))
    return [scan_file(tmp_path / f"{name}.ply", *boxes(shift, count)) for name, shift, count in kinds]


def command(scans, out: Path, prior: Path) -> list[str]:
    settings = out.with_name("quick.yaml")
    settings.write_text(FEW_STEPS)
    return [str(a) for a in ("run", *scans, "--out", out, "--prior", prior, "--config", settings)]


def stopped(argv: list[str], place: str, nth: int, sent: signal.Signals) -> tuple[int, str]:
    """Exit code and standard error of a process that got a signal at the `nth` call of `place`."""
    process = subprocess.Popen(
        [sys.executable, "-c", STOPPING, place, str(nth), *argv],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"JAX_DEFAULT_MATMUL_PRECISION": "highest"},
        preexec_fn=heed_interrupts,
    )
    with process:
        assert process.stdout is not None
        assert any(line == "here\n" for line in process.stdout)
        process.send_signal(sent)
        _, err = process.communicate(timeout=60)
    return process.returncode, err


def told(folder: Path) -> dict:
    """scene.json without the seconds."""
    return {k: v for k, v in json.loads((folder / "scene.json").read_text()).items() if k != "timing_s"}


@POSIX
@pytest.mark.parametrize(
    ("place", "nth", "sent", "kept"),
    [
        pytest.param("object_mesh", 2, signal.SIGINT, 3, marks=pytest.mark.slow),  # between two meshes
        ("to_yaml", 2, signal.SIGKILL, 1),  # while the second scan is saved
        pytest.param("to_yaml", 2, signal.SIGINT, 1, marks=pytest.mark.slow),
        pytest.param(
            "add_scan", 2, signal.SIGINT, 2, marks=pytest.mark.slow
        ),  # while the third scan is added
        pytest.param("reconstruct", 1, signal.SIGKILL, 3, marks=pytest.mark.slow),
    ],
)
def test_a_stopped_run_goes_on_to_the_same_end(tmp_path, three, tiny, capsys, place, nth, sent, kept):
    argv = command(three, tmp_path / "room", tiny)
    code, err = stopped(argv, place, nth, sent)
    if sent == signal.SIGINT:
        assert code == 130
        (line,) = err.splitlines()
        assert line == (
            f"interrupted; {kept} of 3 scans are kept in {tmp_path / 'room'}; "
            "the same command with --resume goes on"
        )
    else:
        assert code == -signal.SIGKILL
    assert [s.name for s in load_scene(tmp_path / "room")[0].scans] == ["a", "b", "c"][:kept]
    assert main([*argv, "--resume"]) == 0
    assert f"{kept} of 3 scans are there" in capsys.readouterr().out
    assert main(command(three, tmp_path / "whole", tiny)) == 0
    assert told(tmp_path / "room") == told(tmp_path / "whole")
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


@POSIX
def test_sigint_before_the_first_scan_is_done_leaves_nothing(tmp_path, three, tiny):
    argv = command(three, tmp_path / "room", tiny)
    assert stopped(argv, "to_yaml", 1, signal.SIGINT) == (130, "interrupted\n")
    assert not [p for p in tmp_path.iterdir() if "room" in p.name]


def test_resume_without_anything_stored_begins(tmp_path, three, tiny, capsys):
    assert run_quickly(three[0], out=tmp_path / "room", prior=tiny, more=["--resume"]) == 0
    assert "begins with a" in capsys.readouterr().out


def test_resume_refuses_what_is_no_beginning(tmp_path, three, tiny, capsys):
    a, b, c = three
    out = tmp_path / "room"
    assert run_quickly(a, b, out=out, prior=tiny) == 0
    before = (out / "scene.json").read_bytes()
    capsys.readouterr()
    options = ["--out", out, "--prior", tiny, "--resume"]
    assert "made with other settings" in refused(capsys, "run", a, b, c, *options)
    options += ["--config", tmp_path / "quick.yaml"]
    assert run_fails(capsys, "holds 2 scans; --resume needs as many or more, got 1", a, options)
    assert run_fails(capsys, f"scan 1 is {b} (2 instances)", a, c, b, options)
    assert run_fails(capsys, "needs it there", scan_file(a, *boxes(0, 3)), b, c, options)  # a was replaced
    scan_file(a, *boxes(0, 2))
    other = tmp_path / "other.npz"
    save_prior(dataclasses.replace(load_prior(tiny), name="other"), other)
    options[options.index(tiny)] = other
    assert run_fails(capsys, "made with prior 'tiny'", a, b, c, options)
    assert (out / "scene.json").read_bytes() == before


def run_fails(capsys, message: str, *argv) -> bool:
    *scans, options = argv
    _, _, line = refused_output(capsys, "run", *scans, *options)
    return message in line


def refused_output(capsys, *argv) -> tuple[int, str, str]:
    code = main([str(a) for a in argv])
    captured = capsys.readouterr()
    assert code == 2
    (line,) = captured.err.splitlines()
    return code, captured.out, line


def test_the_run_log_is_kept_once_over_several_saves(tmp_path, three, tiny):
    assert run_quickly(*three, out=tmp_path / "room", prior=tiny) == 0
    log = (tmp_path / "room/run.log").read_text()
    assert [log.count(f"read {scan}") for scan in three] == [1, 1, 1]
    assert log.count("meshing the scene") == 1


# --- masks, quiet, JSON lines -------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 3])
def test_masks_are_none_or_one_a_scan(tmp_path, three, capsys, count):
    argv = ["run", *three[:2], "--out", tmp_path / "room", "--masks", *[tmp_path] * count]
    line = refused(capsys, *argv)
    assert f"{count} masks for 2 scans; needed none, or one a scan in the same order" in line


def test_masks_and_depth_frames_reach_the_reader_in_order(tmp_path, three, capsys, monkeypatch):
    asked = []

    def read_scan(path, **options):
        asked.append((path, options["masks"], options["depth_frames"], options["segment"]))
        if len(asked) == 2:
            raise ValueError("enough")

    monkeypatch.setattr("more2_jax.scans.read_scan.read_scan", read_scan)
    monkeypatch.setattr(
        building,
        "read",
        lambda s, path, c, reading, masks: read_scan(
            path, masks=masks, depth_frames=reading.depth_frames, segment=reading.segment
        ),
    )
    masks = [tmp_path / "m0", tmp_path / "m1"]
    argv = ["run", *three[:2], "--out", tmp_path / "room", "--masks", *masks, "--depth-frames"]
    assert "enough" in refused(capsys, *argv)
    assert asked == [(three[0], masks[0], True, None), (three[1], masks[1], True, None)]


def test_inspect_and_add_take_masks(tmp_path, stored, three, capsys, monkeypatch):
    asked = []

    def read_scan(path, **options):
        asked.append(options)
        raise ValueError("enough")

    monkeypatch.setattr("more2_jax.scans.read_scan.read_scan", read_scan)
    options = ["--masks", tmp_path / "m", "--unit", "mm", "--depth-frames"]
    refused(capsys, "inspect", three[0], *options)
    refused(capsys, "add", stored, three[0], *options)
    expected = {"masks": tmp_path / "m", "unit": "mm", "depth_frames": True, "segment": None}
    assert all(expected.items() <= got.items() for got in asked)
    assert len(asked) == 2


def test_quiet_and_json_lines_of_a_whole_run(tmp_path, three, tiny, capsys):
    log = tmp_path / "log.jsonl"
    more = ["--quiet", "--log-json", log]
    assert run_quickly(*three[:2], out=tmp_path / "room", prior=tiny, more=more) == 0
    assert capsys.readouterr() == ("", "")
    ended = [e for e in map(json.loads, log.read_text().splitlines()) if e["event"] == "finished"]
    stages = [(e["stage"], e["scan"]) for e in ended]
    assert stages[:4] == [("encode", "a"), ("encode", "b"), ("match", "b"), ("register", "b")]
    assert stages[-1] == ("mesh", None)
    assert all(e["done"] == e["total"] for e in ended)


def test_output_away_from_a_terminal_is_plain_lines(tmp_path, three, tiny, capsys):
    assert run_quickly(*three[:2], out=tmp_path / "room", prior=tiny) == 0
    out = capsys.readouterr().out
    assert all(line.isprintable() for line in out.splitlines())
    assert [out.count(f"{doing} b:") for doing in ("matching", "registering")] == [1, 1]


def test_json_lines_inside_the_scene_are_refused(tmp_path, three, capsys):
    out = tmp_path / "room"
    line = refused(capsys, "run", three[0], "--out", out, "--log-json", out / "log.jsonl")
    assert "inside the living scene" in line
    missing = tmp_path / "nowhere/log.jsonl"
    assert "No such file" in refused(capsys, "run", three[0], "--out", out, "--log-json", missing)


def test_a_large_scene_whose_meshes_wait_in_files_is_stored_the_same(tmp_path, three, tiny, monkeypatch):
    assert main(command(three, tmp_path / "held", tiny)) == 0
    monkeypatch.setattr(building, "LARGE", 1)
    waited, real = [], WaitingMeshes.__call__
    monkeypatch.setattr(WaitingMeshes, "__call__", lambda self, mesh: waited.append(mesh) or real(self, mesh))
    assert main(command(three, tmp_path / "waited", tiny)) == 0
    assert told(tmp_path / "held") == told(tmp_path / "waited")
    objects = sorted((tmp_path / "held" / "objects").iterdir())
    assert len(waited) == sum(not p.name.endswith("_points.ply") for p in objects) > 0
    for path in objects:
        assert (tmp_path / "waited" / "objects" / path.name).read_bytes() == path.read_bytes()
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []
