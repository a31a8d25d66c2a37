"""Runs: resumed by scene, never mixed with other settings, the same on many devices; the programs on one scene."""

import dataclasses
import json
import os
import subprocess
import sys

import numpy as np
import pytest
from known_scenes import known_scene
from places import ROOT
from published_folder import write_published

from eval import everything, report
from eval.data.truth import KnownScene
from eval.harness.batched import PairToRegister, embed_all, register_all
from eval.harness.options import Options, OptionsBeside, less_told
from eval.harness.plots import draw_ecdf, draw_over_scans
from eval.harness.results import finish
from eval.harness.runs import open_run, run_scenes, start_run, weights_digest
from eval.matching import match_own
from eval.scores.figures import Figure
from more2_jax.config import DescentRegistration, SceneConfig, preset
from more2_jax.network.embedding_batch import embed
from more2_jax.network.prior import save_prior
from more2_jax.types import ObservedObject, Scan


@pytest.fixture
def data(tmp_path):
    for name in "abc":
        write_published(tmp_path / "data" / name)
    return tmp_path / "data"


@pytest.fixture
def options(data, tmp_path, tiny_prior):
    save_prior(tiny_prior, tmp_path / "tiny.npz")
    return Options(data=data, out=tmp_path / "out", prior=str(tmp_path / "tiny.npz"), chunk=2, peers=False)


def counting(done):
    def work(scenes):
        done.extend(s.name for s in scenes)
        return [[{"method": "m", "e": float(len(s.objects)), "bad": float("nan")}] for s in scenes]

    return work


def test_a_stopped_run_resumes_with_the_scenes_that_are_left(options):
    done = []

    def stops(scenes):
        if done:
            raise KeyboardInterrupt
        return counting(done)(scenes)

    with pytest.raises(KeyboardInterrupt):
        run_scenes(start_run("test", options, {}), options, stops)
    assert done == ["a", "b"]
    run = start_run("test", options, {})
    assert set(run.records()) == {"a", "b"}
    records = run_scenes(run, options, counting(done))
    assert done == ["a", "b", "c"]
    assert records == {n: [{"method": "m", "e": 4.0, "bad": None}] for n in "abc"}
    assert not list(options.out.rglob("*.partial*"))


def test_other_settings_need_another_folder(options):
    run_scenes(start_run("test", options, {}), options, counting([]))
    other = dataclasses.replace(options, preset="paper")
    with pytest.raises(ValueError, match="holds a run with other config, preset"):
        start_run("test", other, {})
    fresh = start_run("test", dataclasses.replace(other, fresh=True), {})
    assert fresh.records() == {}


def test_the_vertical_is_found_by_whole_scenes_alone(options):
    found = dataclasses.replace(options, upright="found")
    assert open_run("end_to_end", found, {}).config.upright is None
    assert open_run("end_to_end", options, {}).config.upright is False  # as these data were made
    with pytest.raises(ValueError, match="matching: upright found; needed auto, yes or no"):
        open_run("matching", found, {})


def test_rooms_are_withheld_scan_by_scan(options):
    scans = [Scan(name=n, source=n, instances=(), background=np.ones((4, 3))) for n in "abc"]
    scene = KnownScene(name="s", scans=tuple(scans), objects=())
    kept = {
        rooms: [len(s.background) for s in less_told(scene, dataclasses.replace(options, rooms=rooms)).scans]
        for rooms in ("all", "first", "none")
    }
    assert kept == {"all": [4, 4, 4], "first": [4, 0, 0], "none": [0, 0, 0]}


def test_results_name_command_data_and_hardware(options):
    run = start_run("matching", options, {})
    records = run_scenes(run, options, counting([]))
    rows = finish(run, options, [Figure(name="e", key="e", statistic="mean")], records)
    found = json.loads((options.out / "results.json").read_text())
    assert {"name", "value", "unit", "better", "count", "failures", "ci95"} <= set(found["rows"][0])
    assert found["rows"][0]["value"] == rows[0].value == 4
    assert found["settings"]["data"]["digest"] and found["settings"]["weights"] and found["hardware"]
    assert "| e | 3 |" in (options.out / "tables.md").read_text()
    assert "\\toprule" in (options.out / "tables.tex").read_text()
    page = options.out / "page.md"
    report.main((options.out.parent,), page, "with a note")
    text = page.read_text()
    assert "with a note" in text and "| e | 3 | 4 (4 to 4) |" in text and "88.75" in text
    with pytest.raises(ValueError, match=r"no results.json"):
        report.main((options.data,), page)


@pytest.mark.slow
def test_fixed_batches_give_what_single_calls_give(tiny_prior):
    scene = known_scene(scans=2, points=300)
    clouds = [i.points for s in scene.scans for i in s.instances]
    codes = embed_all(tiny_prior, clouds, 3)
    alone = [embed(tiny_prior, [c])[0] for c in clouds]
    for a, b in zip(codes, alone, strict=True):
        np.testing.assert_allclose(a.inv, b.inv, atol=1e-5)
        np.testing.assert_allclose(a.origin, b.origin)
    method = DescentRegistration(points=64, sdf_points=16, steps=2, icp_steps=3)
    seen = [ObservedObject(points=c, embedding=e) for c, e in zip(clouds, codes, strict=True)]
    pairs = [PairToRegister(source=seen[4 + k], target=seen[k]) for k in range(4)]
    together = register_all(tiny_prior, pairs, method, "free", 3)
    alone = [register_all(tiny_prior, [p], method, "free", 3)[0] for p in pairs]
    np.testing.assert_allclose(together, alone, atol=1e-4)


def test_matching_of_nothing(tiny_prior):
    scan = known_scene().scans[0].instances
    assert match_own(tiny_prior, [], [], scan, [], SceneConfig()) == {}
    assert match_own(tiny_prior, scan, [], [], [], SceneConfig()) == {}


@pytest.mark.slow
@pytest.mark.parametrize("devices", [2])
def test_the_same_on_many_devices(devices, options, tmp_path):
    """A run of the program itself, its batches spread over devices that are pretended."""
    command = [sys.executable, "-m", "eval.matching", "--data", options.data, "--prior", options.prior]
    command += ["--scenes", "1", "--no-peers", "--preset", "paper", "--batch", "4"]
    rows = []
    for count in (1, devices):
        env = {**os.environ, "JAX_NUM_CPU_DEVICES": str(count), "JAX_PLATFORMS": "cpu"}
        out = tmp_path / f"on_{count}"
        subprocess.run(
            [*map(str, command), "--out", str(out)], cwd=ROOT, env=env, check=True, capture_output=True
        )
        found = json.loads((out / "results.json").read_text())["rows"]
        # The scene has two copies: which of them is taken for which, rounding may decide.
        rows.append([(r["name"], r["value"]) for r in found if r["column"] == "strict"])
    assert rows[0] == rows[1]


def test_bad_input_is_one_line_and_exit_code_2(tmp_path):
    command = [sys.executable, "-m", "eval.matching", "--data", str(tmp_path), "--out", str(tmp_path / "o")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.startswith("error: ") and done.stderr.count("\n") == 1


def test_plots_are_written_twice_and_are_the_same_every_time(tmp_path):
    pytest.importorskip("matplotlib")
    records = [{"method": "m", "e": v} for v in (1.0, 2.0, None)]
    files = draw_ecdf(tmp_path / "ecdf", records, "e", "error", 5)
    assert [f.suffix for f in files] == [".png", ".svg"] and all(f.stat().st_size > 1000 for f in files)
    first = files[1].read_bytes()
    assert draw_ecdf(tmp_path / "ecdf", records, "e", "error", 5)[1].read_bytes() == first
    assert len(draw_over_scans(tmp_path / "scans", [], {"coverage": "coverage"})) == 2


def test_every_program_can_be_asked_for():
    # The decoding study is of shapes, not of scenes: it has a command of its own.
    assert {*everything.PROGRAMS, "decoding"} == set(report.TITLES)
    assert preset("robust").preset in everything.Settings(data=(), out=ROOT).presets


@pytest.mark.slow
def test_all_programs_on_one_scene(tmp_path, tiny_prior):
    """From meshes to the page of tables."""
    pytest.importorskip("open3d")
    from pieces import furniture

    from train import synthesize
    from train.furniture.collections import write_packed

    write_packed(tmp_path / "f.npz", list(furniture()))
    synthesize.main(
        synthesize.Settings(source=tmp_path / "f.npz", regime="sparse", out=tmp_path / "d", scenes=1, scans=2)
    )
    save_prior(tiny_prior, tmp_path / "tiny.npz")
    everything.main(
        everything.Settings(
            data=(tmp_path / "d",),
            out=tmp_path / "runs",
            prior=str(tmp_path / "tiny.npz"),
            scans=(2,),
            samples=500,
        )
    )
    page = (tmp_path / "runs" / "results_tables.md").read_text()
    assert all(f"### {report.TITLES[p]}" in page for p in everything.PROGRAMS)


def test_peers_that_cannot_run_are_told_before_the_first_scene(options, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)  # an import of it fails
    with pytest.raises(ValueError, match=r"open3d .*install more2-jax\[peers\]"):
        start_run("test", dataclasses.replace(options, peers=True), {})
    assert not options.out.exists()
    start_run("test", options, {})


def test_presets_without_descent_are_those_that_descend_and_differ_in_its_steps_alone(tmp_path):
    asked = OptionsBeside(data=tmp_path, out=tmp_path, preset="paper", beside=("field", "robust", "paper"))
    names = [f"ours, {name}" for name in ("paper", "field", "robust")]
    assert list(asked.methods(True)) == names
    found = dataclasses.replace(asked, without_descent=True).methods(True)
    assert list(found) == [*names, "ours, paper, without descent", "ours, field, without descent"]
    for name in ("paper", "field"):
        whole, starts = found[f"ours, {name}"], found[f"ours, {name}, without descent"]
        assert whole == preset(name, upright=True)
        assert whole.registration.steps > 0
        assert starts.registration.steps == 0
        steps = {
            k: getattr(whole.registration, k)
            for k in ("steps", "search_steps")
            if hasattr(whole.registration, k)
        }
        restored = dataclasses.replace(starts.registration, **steps)
        assert dataclasses.replace(starts, registration=restored) == whole


def test_records_of_other_draws_of_the_same_weights_are_not_taken_for_ones_own(tiny_prior):
    config = dataclasses.replace(tiny_prior.config, draws=4)
    other = dataclasses.replace(tiny_prior, config=config)
    assert weights_digest(other) != weights_digest(tiny_prior)
    assert weights_digest(dataclasses.replace(other, config=tiny_prior.config)) == weights_digest(tiny_prior)
