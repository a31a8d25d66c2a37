"""`more2 …` from outside: what it prints, what it leaves on disk, its exit codes."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from factories import living_scene
from rich.table import Table

from more2_jax.cli import main
from more2_jax.commands import scenes
from more2_jax.commands.session import Session, cache_folder
from more2_jax.commands.settings import scene_config
from more2_jax.config import TrainingRun, load_config, preset
from more2_jax.io import load_scene, save_scene
from more2_jax.meshfile import write_points
from more2_jax.prior import init_prior, load_prior, save_prior

TINY = load_config(Path(__file__).parents[1] / "configs/tiny.yaml", TrainingRun).model
# Few steps: the command line is under test here, not the method.
QUICK = """
registration:
  {points: 64, coarse_points: 32, coarse_steps: 2, keep_starts: 1, yaw_starts: 0, steps: 2, icp_steps: 2}
joint: {points: 64, steps: 2}
meshing: {coarse: 8, resolution: 16}
matching: {reject_residual: 0.0}
"""


def run_quickly(*scans: Path, out: Path, prior: Path, unit: str = "m") -> int:
    """`more2 run` with few steps."""
    settings = out.with_name("quick.yaml")
    settings.write_text(QUICK)
    options = ["--out", out, "--prior", prior, "--config", settings, "--unit", unit]
    return main([str(a) for a in ("run", *scans, *options)])


def boxes(shift: float = 0.0, count: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Points of `count` boxes of different proportions beside each other, metres, and their instance ids."""
    rng = np.random.default_rng(0)
    sizes = np.array([[1.0, 0.5, 0.3], [0.4, 0.4, 1.2], [0.8, 0.9, 0.5]])[:count]
    clouds = [rng.uniform(-0.5, 0.5, (100, 3)) * s + [2.0 * k + shift, 0, 0] for k, s in enumerate(sizes)]
    return np.concatenate(clouds), np.repeat(np.arange(count) + 1, 100)


def scan_file(path: Path, points=None, ids=None, name="instance") -> Path:
    default = boxes()
    write_points(path, default[0] if points is None else points, default[1] if ids is None else ids, name)
    return path


@pytest.fixture(scope="session")
def tiny(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "tiny.npz"
    save_prior(init_prior(TINY, jax.random.key(0), "tiny"), path)
    return path


@pytest.fixture(autouse=True)
def own_cache(monkeypatch, tmp_path_factory):
    monkeypatch.setenv("MORE2_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.fixture
def stored(tmp_path) -> Path:
    save_scene(living_scene(), tmp_path / "room", preset("robust", upright=True))
    return tmp_path / "room"


def refused(capsys, *argv: object) -> str:
    """The one line of standard error of a command that must exit with 2."""
    assert main([str(a) for a in argv]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    return lines[0]


# --- the whole job ------------------------------------------------------------------------------------------


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
    assert (scene.preset, scene.prior, config.joint.steps, config.matching.score) == (
        "robust",
        "tiny",
        2,
        "inv",
    )
    assert "reconstructing" in (out / "run.log").read_text()
    assert main(["add", str(out), str(c), "--prior", str(tiny)]) == 0
    added, again = load_scene(out)
    assert [s.name for s in added.scans] == ["a", "b", "c"]
    assert again == config
    assert added.objects[0].id == scene.objects[0].id
    assert sum(len(o.observations) for o in added.objects) == 7
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_demo_runs_on_the_bundled_scans_and_ends_with_the_truth(tmp_path, capsys, monkeypatch):
    asked = []
    monkeypatch.setattr(scenes, "run_scans", lambda *args: asked.append(args) or living_scene())
    monkeypatch.setattr(
        "more2_jax.demo.demo_table", lambda scene: (Table("truth"), f"{len(scene.objects)} right")
    )
    monkeypatch.chdir(tmp_path)
    assert main(["demo"]) == 0
    ((paths, out, config, prior),) = asked
    assert (len(paths), out, prior) == (3, Path("demo_scene"), "small")
    assert all(path.is_file() for path in paths)
    assert config == preset("robust", upright=True)
    assert capsys.readouterr().out.splitlines()[-1] == "5 right"


def test_one_scan_is_reconstructed_without_changes(tmp_path, tiny, capsys):
    a = scan_file(tmp_path / "a.ply")
    assert run_quickly(a, out=tmp_path / "room", prior=tiny) == 0
    scene, _ = load_scene(tmp_path / "room")
    assert scene.changes == ()
    assert [o.mesh is not None for o in scene.objects] == [True, True]


def test_ctrl_c_leaves_nothing_and_exits_with_130(tmp_path, tiny, capsys, monkeypatch):
    def interrupted(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr("more2_jax.scene.start_scene", interrupted)
    a = scan_file(tmp_path / "a.ply")
    assert main(["run", str(a), "--out", str(tmp_path / "room"), "--prior", str(tiny)]) == 130
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]


def test_ctrl_c_while_writing_leaves_the_old_scene(tmp_path, stored, monkeypatch):
    def interrupted(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr("more2_jax.io.write_report", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save_scene(dataclasses.replace(living_scene(), prior="newer"), stored, preset("robust"))
    assert load_scene(stored)[0].prior == "small"
    assert [p.name for p in tmp_path.iterdir()] == ["room"]


@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT")
def test_sigint_to_the_process_exits_with_130(tmp_path, tiny):
    code = (
        "import sys, time, more2_jax.commands.scenes as s; from more2_jax.cli import main\n"
        "s._read = lambda *a: (print('waiting', flush=True), time.sleep(60))\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    argv = [sys.executable, "-c", code, "run", "a.ply", "--out", str(tmp_path / "room"), "--prior", str(tiny)]
    with subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "waiting\n"
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=30)
    assert (process.returncode, err) == (130, "interrupted\n")
    assert not (tmp_path / "room").exists()


# --- bad input: one line, exit code 2 -----------------------------------------------------------------------


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
def test_millimetres_are_warned_of_and_scaled(tmp_path, tiny, capsys, unit, warned):
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
    monkeypatch.setattr(scenes, "_read", lambda *args: pytest.fail("a scan was read"))
    line = refused(capsys, "run", "a.ply", "--out", tmp_path / "taken")
    assert "output folder not empty and not a living scene" in line
    assert (tmp_path / "taken/thesis.tex").read_text() == "years"


def test_scans_are_all_read_before_the_prior(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("more2_jax.prior.load_prior", lambda name: pytest.fail("the prior was loaded"))
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


# --- help, show, export, prior ------------------------------------------------------------------------------

SCENES = ("demo", "run", "add", "inspect", "show", "export")
COMMANDS = (*SCENES, *(f"prior {p}" for p in ("list", "info", "import", "check")))
ACTIONS = (
    *(f"scenes.{name}" for name in (*SCENES, "run_scans") if name != "run"),
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
        monkeypatch.setattr(f"more2_jax.commands.{name}", lambda *a, **k: called.append(a) or 0)
    assert main(example.split()[2:]) == 0
    assert len(called) == 1


def test_help_does_not_wait_for_jax():
    code = "import sys, more2_jax.cli\nassert 'jax' not in sys.modules and 'trimesh' not in sys.modules"
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


def test_prior_info(tiny, capsys):
    assert main(["prior", "info", str(tiny)]) == 0
    told = capsys.readouterr().out
    parameters = sum(leaf.size for leaf in jax.tree.leaves(load_prior(tiny).params))
    assert f"tiny: {parameters:,} parameters" in told
    assert "code: 16" in told


def test_prior_list_names_what_is_shipped(tiny, capsys, monkeypatch):
    prior = load_prior(tiny)
    monkeypatch.setattr("more2_jax.prior.shipped_priors", lambda: ["one", "two"])
    monkeypatch.setattr("more2_jax.prior.load_prior", lambda name: prior)
    assert main(["prior", "list"]) == 0
    told = capsys.readouterr().out
    assert "one" in told
    assert "two" in told
    monkeypatch.setattr("more2_jax.prior.shipped_priors", list)
    assert main(["prior", "list"]) == 0
    assert "no weights are shipped" in capsys.readouterr().out


GOOD = {"F_inv": 1e-7, "F_eqv": 2e-7, "F_s": 0.0, "F_c": 3e-7, "sdf": 9.9e-6}


@pytest.mark.parametrize(
    ("deviations", "code"),
    [
        (GOOD, 0),
        (GOOD | {"F_c": 1e-5}, 1),
        (GOOD | {"sdf": float("nan")}, 1),
        (GOOD | {"F_s": float("inf")}, 1),
    ],
)
@pytest.mark.parametrize("alone", [True, False])
def test_prior_check_passes_only_below_the_limit(monkeypatch, capsys, deviations, code, alone):
    reference, inside, outside = {"points": 1}, {"weights": "inside"}, {"weights": "outside"}
    asked = []
    stand_ins = {
        "read_reference": lambda path: asked.append(path.name) or reference,
        "weights_of_reference": lambda arrays: inside,
        "read_checkpoint": lambda path: outside,
        "check_prior": lambda weights, arrays: asked.append(weights) or deviations,
    }
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(f"more2_jax.checkpoint.{name}", stand_in)
    files = ["reference.npz"] if alone else ["published.pt", "reference.npz"]
    assert main(["prior", "check", *files]) == code
    assert asked == ["reference.npz", inside if alone else outside]
    told = capsys.readouterr().out
    assert all(f"{name:6} {value:.2e}" in told for name, value in deviations.items())


def test_prior_import_writes_full_precision_once(tmp_path, tiny, monkeypatch, capsys):
    half = load_prior(tiny)
    exact = dataclasses.replace(half, params=jax.tree.map(lambda v: v / 3, half.params))
    monkeypatch.setattr("more2_jax.checkpoint.read_checkpoint", lambda path: {"read": path})
    converted = "more2_jax.published.prior_from_published"
    monkeypatch.setattr(converted, lambda weights, name: dataclasses.replace(exact, name=name))
    out = tmp_path / "deep/mine.npz"
    assert main(["prior", "import", "published.pt", str(out)]) == 0
    again = load_prior(out)
    assert again.name == "mine"
    jax.tree.map(np.testing.assert_array_equal, again.params, exact.params)
    assert [p.name for p in out.parent.iterdir()] == ["mine.npz"]
    capsys.readouterr()
    assert "exists" in refused(capsys, "prior", "import", "published.pt", out)
    assert "needed .npz" in refused(capsys, "prior", "import", "published.pt", tmp_path / "mine.pt")


def test_prior_import_of_no_checkpoint(tmp_path, capsys):
    assert "no such file" in refused(capsys, "prior", "import", tmp_path / "none.pt", tmp_path / "out.npz")
    (tmp_path / "text.pt").write_text("hello")
    refused(capsys, "prior", "import", tmp_path / "text.pt", tmp_path / "out.npz")
    assert not (tmp_path / "out.npz").exists()


def test_cache_folder_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("MORE2_CACHE", str(tmp_path / "own"))
    assert cache_folder() == tmp_path / "own"
    monkeypatch.delenv("MORE2_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_folder() == tmp_path / "xdg/more2_jax"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    assert cache_folder() == tmp_path / ".cache/more2_jax"
