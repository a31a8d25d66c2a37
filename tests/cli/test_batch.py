"""`more2 batch`: each scene as `more2 run` makes it, once; a rotten row costs itself; what lies on disk is kept."""

import csv
import json
import os
import signal
import time

import psutil
import pytest
from command_line import FEW_STEPS, boxes, refused, run_quickly, scan_file
from inline_team import Inline
from stages_by_mask import stages_by_mask

from more2_jax import report, scene
from more2_jax.cli import batch
from more2_jax.cli.main import main
from more2_jax.cli.manifest import RottenRow, SceneJob, read_manifest
from more2_jax.cli.options import Reading
from more2_jax.storage.scene_folder import load_scene

pytestmark = pytest.mark.optimized  # scenes run for longer than their programs compile


@pytest.fixture
def inline(monkeypatch):
    teams = []
    monkeypatch.setattr(batch, "team_of", lambda *_: teams.append(Inline()) or teams[-1])
    return teams


@pytest.fixture
def place(tmp_path, tiny):
    """Scans a and b, and quick settings."""
    for name, shift in (("a", 0.0), ("b", 0.3)):
        scan_file(tmp_path / f"{name}.ply", *boxes(shift))
    (tmp_path / "quick.yaml").write_text(FEW_STEPS)
    return tmp_path


def written(place, tiny, *rows, columns="name,scans,config,prior"):
    """A manifest of rows: name and scans; settings and weights are added."""
    path = place / "scenes.csv"
    lines = [columns, *(row if row.count(",") > 1 else f"{row},quick.yaml,{tiny}" for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def results(out):
    with (out / "results.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(autouse=True)
def without_pyarrow(monkeypatch):
    """The table is CSV here, whatever is installed; Parquet has a test of its own."""
    import sys

    monkeypatch.setitem(sys.modules, "pyarrow", None)


def go(path, out, *more):
    return main(["batch", str(path), "--out", str(out), *more])


def test_each_scene_is_what_run_makes_of_it_and_a_rotten_row_costs_itself(place, tiny, inline, capsys):
    out = place / "all"
    path = written(
        place,
        tiny,
        "one,a.ply;b.ply",
        "rotten,a.ply;gone.ply",
        "alone, b.ply ",
        "bad,empty.ply",
        "../up,a.ply",
    )
    (place / "empty.ply").write_text("ply")
    assert go(path, out) == 1
    told = capsys.readouterr()
    lines = told.err.splitlines()
    assert len(lines) == 3
    assert f"error: row 2 (rotten): {place / 'gone.ply'}: no such file or folder" in lines
    assert any(line.startswith("error: row 4 (bad): ") and "empty.ply" in line for line in lines)
    assert any("row 5 (../up): name '../up' is no name of a folder" in line for line in lines)
    assert "2 scenes done, 0 were finished before, 3 failed" in told.out
    rows = results(out)
    assert [(r["row"], r["status"]) for r in rows] == [
        ("1", "done"), ("2", "failed"), ("3", "done"), ("4", "failed"), ("5", "failed"),
    ]  # fmt: skip
    assert (rows[0]["scans"], rows[0]["objects"], rows[2]["scans"]) == ("2", "2", "1")
    assert "no such file" in rows[1]["error"] and float(rows[0]["seconds"]) > 0
    assert run_quickly(place / "a.ply", place / "b.ply", out=place / "plain", prior=tiny) == 0
    assert told_of(out / "one") == told_of(place / "plain")
    assert sorted(p.name for p in out.iterdir()) == ["alone", "one", "results.csv"]


def test_one_rotten_row_in_a_hundred(place, tiny, inline, capsys, monkeypatch):
    """99 scenes are there and one line is said; the next call tries the one alone, and with its scan mended all are."""
    monkeypatch.setattr(report, "report_html", lambda *_: "")  # takes a third of the time
    out, names = place / "all", [f"room_{k:02d}" for k in range(100)]
    rows = [f"{n},{'cut.ply' if n == 'room_42' else 'a.ply'},{tiny}" for n in names]
    path = written(place, tiny, *rows, columns="name,scans,prior")
    whole = (place / "a.ply").read_bytes()
    (place / "cut.ply").write_bytes(whole[: len(whole) // 2])
    with stages_by_mask():
        assert go(path, out) == 1
        told = capsys.readouterr()
        (line,) = told.err.splitlines()
        assert line.startswith("error: row 43 (room_42): ") and "cut.ply" in line
        assert "99 scenes done, 0 were finished before, 1 failed" in told.out
        scenes = {p.parent.name: p.stat().st_mtime_ns for p in out.glob("*/scene.json")}
        assert sorted(scenes) == [n for n in names if n != "room_42"]
        assert [r["name"] for r in results(out) if r["status"] == "failed"] == ["room_42"]
        assert go(path, out) == 1
        assert inline[-1].tasks == ["room_42"] and capsys.readouterr().err == told.err
        (place / "cut.ply").write_bytes(whole)
        assert go(path, out) == 0
    assert [r["status"] for r in results(out)] == ["done" if n == "room_42" else "kept" for n in names]
    assert {n: (out / n / "scene.json").stat().st_mtime_ns for n in scenes} == scenes
    assert sorted(p.name for p in out.iterdir()) == ["results.csv", *names]


def test_the_largest_scene_begins_first_and_the_results_are_in_the_order_of_the_rows(place, tiny, inline):
    scan_file(place / "large.ply", *boxes(count=3))
    rows = ["small,a.ply", "two,a.ply;b.ply", "large,a.ply;large.ply", "also small,b.ply"]
    with stages_by_mask():
        assert go(written(place, tiny, *rows), place / "all") == 0
    assert inline[-1].tasks == ["large", "two", "small", "also small"]
    assert [r["name"] for r in results(place / "all")] == ["small", "two", "large", "also small"]


def told_of(folder):
    """scene.json without the seconds, and the bytes of all objects and codes."""
    content = json.loads((folder / "scene.json").read_text())
    files = sorted([*(folder / "objects").iterdir(), folder / "embeddings.npz", folder / "config.yaml"])
    return {k: v for k, v in content.items() if k != "timing_s"}, [(f.name, f.read_bytes()) for f in files]


def test_what_lies_on_disk_is_kept(place, tiny, inline, capsys):
    out = place / "all"
    path = written(place, tiny, "one,a.ply;b.ply", "two,b.ply;a.ply")
    assert go(path, out) == 0
    before = {p: p.stat().st_mtime_ns for p in out.rglob("scene.json")}
    table = results(out)
    (out / "results.csv").unlink()  # no log is needed
    assert go(path, out, "--quiet") == 0
    assert capsys.readouterr().err == ""
    assert len(inline) == 1  # no worker was started
    assert {p: p.stat().st_mtime_ns for p in before} == before
    assert results(out) == [r | {"status": "kept"} for r in table]


@pytest.mark.parametrize("stage", ["add_scan", "reconstruct"])
def test_what_is_half_done_goes_on_to_the_same_end(place, tiny, inline, capsys, monkeypatch, stage):
    out = place / "all"
    assert go(written(place, tiny, "two,b.ply;a.ply"), place / "whole") == 0
    path = written(place, tiny, "one,a.ply;b.ply", "two,b.ply;a.ply")
    real, calls = getattr(scene, stage), []

    def stopping(*args, **kwargs):
        calls.append(stage)
        if len(calls) == 2:
            raise ValueError("stopped in the second scene")
        return real(*args, **kwargs)

    with monkeypatch.context() as patched:
        patched.setattr(scene, stage, stopping)
        assert go(path, out) == 1
    assert capsys.readouterr().err == "error: row 2 (two): stopped in the second scene\n"
    assert len(load_scene(out / "two")[0].scans) == (1 if stage == "add_scan" else 2)
    assert go(path, out) == 0
    assert inline[-1].tasks == ["two"]
    assert told_of(out / "two") == told_of(place / "whole/two")


def test_other_settings_are_not_mixed_in(place, tiny, inline, capsys):
    out = place / "all"
    assert go(written(place, tiny, "one,a.ply"), out) == 0
    before = (out / "one/scene.json").read_bytes()
    path = written(
        place, tiny, f"one,a.ply,quick.yaml,{tiny},true", columns="name,scans,config,prior,upright"
    )
    assert go(path, out) == 1
    assert "made with other settings; --resume needs the same" in capsys.readouterr().err
    assert (out / "one/scene.json").read_bytes() == before
    assert go(written(place, tiny, "one,b.ply"), out) == 1
    assert "--resume needs it there" in capsys.readouterr().err


def test_the_cells_of_a_row_are_the_options_of_run(place, tiny):
    columns = (
        "name, scans, out, masks, preset, upright, prior, keep_masks, config, unit, segment, up, depth_frames"
    )
    row = f"x, a.ply; {place}/b.ply, d/er, b.ply;a.ply, paper, yes, {tiny.name}, 1, quick.yaml, mm, geometric, -y, no"
    path = written(place, tiny, row, columns=columns)
    (place / tiny.name).write_bytes(tiny.read_bytes())
    (job,) = read_manifest(path, place / "out")
    assert isinstance(job, SceneJob)
    assert job.scans == (place / "a.ply", place / "b.ply") and job.masks == (place / "b.ply", place / "a.ply")
    assert job.out == place / "out/d/er" and job.prior == str(place / tiny.name)
    assert job.reading == Reading(unit="mm", segment="geometric", up="-y", depth_frames=False)
    config = job.settings()
    assert (config.preset, config.upright, config.repair_masks, config.meshing.resolution) == (
        "paper", True, False, 16,
    )  # fmt: skip
    (plain,) = read_manifest(written(place, tiny, "x,a.ply"), place / "out")
    assert isinstance(plain, SceneJob)
    assert (plain.preset, plain.upright, plain.masks, plain.out) == ("robust", None, (), place / "out/x")


@pytest.mark.parametrize(
    ("cells", "says"),
    [
        ("x,a.ply,sideways,,", "got 'sideways'; needed one of robust, field, paper"),
        ("x,a.ply,,maybe,", "got 'maybe'; needed true or false"),
        ("x,,,,", "no scans; needed one"),
        (",a.ply,,,", "no name; needed one"),
        ("x,a.ply,,,gone.yaml", "gone.yaml: no such settings file"),
        ("x,a.ply,,,,left,over", "2 cells more than columns"),
        ("ok,a.ply,,,", "its folder"),  # row 1 has it already
    ],
)
def test_a_rotten_row_says_why_in_one_line(place, tiny, cells, says):
    columns = "name,scans,preset,upright,config"
    good, rotten, after = read_manifest(
        written(place, tiny, "ok,a.ply,,,", cells, "after,b.ply,paper,,", columns=columns), place / "out"
    )
    assert isinstance(good, SceneJob) and isinstance(after, SceneJob)
    assert isinstance(rotten, RottenRow)
    assert rotten.row == 2 and says in rotten.error and "\n" not in rotten.error


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "columns ; needed name and scans"),
        ("name,scans\n", "no rows; needed a scene at least"),
        ("name\nx\n", "columns name; needed name and scans"),
        ("name,scans,colour\nx,a.ply,red\n", "unknown column colour; known are out, name, scans"),
        (b"name,scans\n\xff\xfe,x\n", "neither CSV in UTF-8"),
    ],
)
def test_a_file_that_is_no_manifest_is_one_line(place, capsys, text, says):
    path = place / "scenes.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    assert says in refused(capsys, "batch", path, "--out", place / "all")
    assert not (place / "all").exists()
    assert "No such file" in refused(capsys, "batch", place / "gone.csv", "--out", place / "all")
    assert "Parquet needs pyarrow" in refused(capsys, "batch", place / "gone.parquet", "--out", place / "all")
    for option, says in (("--workers", "1 or more"), ("--scene-minutes", "more than 0")):
        said = refused(capsys, "batch", path, "--out", place / "all", option, 0)
        assert f"{option} 0; needed {says}" in said


@pytest.mark.slow
def test_parquet_in_and_out(place, tiny, inline, monkeypatch):
    monkeypatch.undo()
    arrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    monkeypatch.setattr(batch, "team_of", lambda *_: Inline())
    rows = [
        {
            "name": "one",
            "scans": ["a.ply", "b.ply"],
            "config": "quick.yaml",
            "prior": str(tiny),
            "keep_masks": True,
        },
        {"name": "none", "scans": None, "config": None, "prior": None, "keep_masks": None},
    ]
    parquet.write_table(arrow.Table.from_pylist(rows), place / "scenes.parquet")
    assert go(place / "scenes.parquet", place / "all") == 1
    found = parquet.read_table(place / "all/results.parquet").to_pylist()
    assert [(r["name"], r["status"], r["objects"]) for r in found] == [
        ("one", "done", 2),
        ("none", "failed", None),
    ]
    assert not load_scene(place / "all/one")[1].repair_masks
    (place / "bad.parquet").write_text("no")
    with pytest.raises(ValueError, match="not Parquet"):
        read_manifest(place / "bad.parquet", place / "all")


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="sends signals")
def test_a_worker_that_is_killed_costs_nothing(place, tiny, capsys):
    """Two processes; the first that has begun a scene is killed: all scenes are there, each built to its end once."""
    names = [f"room_{k}" for k in range(6)]
    path = written(place, tiny, *(f"{n},a.ply;b.ply" for n in names))
    killed = []

    def kill_one():
        end = time.monotonic() + 120
        while time.monotonic() < end and not killed:
            if list((place / "all").glob("room_*")):
                workers = [
                    p
                    for p in psutil.Process().children(recursive=True)
                    if "spawn_main" in " ".join(p.cmdline())
                ]
                os.kill(workers[0].pid, signal.SIGKILL)
                killed.append(workers[0].pid)
            time.sleep(0.05)

    import threading

    thread = threading.Thread(target=kill_one)
    thread.start()
    code = go(path, place / "all", "--workers", "2")
    thread.join()
    assert len(killed) == 1 and code == 0
    assert capsys.readouterr().err == ""
    assert [r["status"] for r in results(place / "all")] == ["done"] * 6
    logs = [(place / "all" / n / "run.log").read_text() for n in names]
    assert all(log.count("objects over 2 scans; seconds") == 1 for log in logs)
    assert not [p for p in (place / "all").iterdir() if p.name.startswith(".")]
