"""Shards that know nothing of one another: merged, they are one run; what does not belong together is refused."""

import dataclasses
import json
import shutil
import sys
from types import ModuleType

import numpy as np
import pytest
from inline_team import Inline
from known_scenes import known_scene
from published_folder import write_published

from eval import matching, merge
from eval.harness import program
from eval.harness.options import Options
from eval.harness.program import Program, Summary, carry_out
from eval.harness.run_folder import RunFolder
from eval.harness.runs import open_run, unfinished_chunks
from eval.scores.figures import Figure
from more2_jax.network.prior import save_prior
from more2_jax.workers.shares import shard_of

NAMES = [f"scene_{k}" for k in range(7)]
DATED = ("date",)  # of results.json: when, not what


def records_of(scene):
    """Numbers that only the scene decides."""
    rng = np.random.default_rng(sum(map(ord, scene.name)))
    return [
        {"method": "m", "e": float(e), "kind": k} for k, e in zip("aab", rng.uniform(size=3), strict=True)
    ]


@pytest.fixture
def drawn(monkeypatch):
    """A program without any computing, importable by its name."""
    module = ModuleType("eval.drawn")
    done: list[str] = []

    def prepare(o):
        def work(scenes):
            done.extend(s.name for s in scenes)
            return [records_of(s) for s in scenes]

        return open_run("drawn", o, {}), work

    figures = [Figure(name="e", key="e", statistic=s) for s in ("mean", "median")]
    summary = Summary(figures=figures, groups=("kind",))
    module.PROGRAM = Program(settings=Options, prepare=prepare, summary=lambda o, right_deg: summary)
    module.done = done
    monkeypatch.setitem(sys.modules, "eval.drawn", module)
    return module


@pytest.fixture
def options(tmp_path, tiny_prior):
    for name in NAMES:
        write_published(tmp_path / "data" / name)
    save_prior(tiny_prior, tmp_path / "tiny.npz")
    return Options(
        data=tmp_path / "data", out=tmp_path / "whole", prior=str(tmp_path / "tiny.npz"), chunk=2, peers=False
    )


def result(out):
    """results.json without its date, and the tables' bytes."""
    content = json.loads((out / "results.json").read_text())
    return {k: v for k, v in content.items() if k not in DATED}, [
        (out / name).read_bytes() for name in ("tables.md", "tables.tex")
    ]


def shards(options, count, folder="shard"):
    return [
        dataclasses.replace(options, out=options.out.with_name(f"{folder}_{i}"), shard=f"{i}/{count}")
        for i in range(1, count + 1)
    ]


@pytest.mark.parametrize(("count", "together"), [(1, False), (2, False), (2, True), (5, True)])
def test_merged_shards_are_one_run_to_the_bit(options, drawn, count, together, tmp_path):
    carry_out(drawn.PROGRAM, options)
    expected = result(options.out)
    (options.out).rename(tmp_path / "kept")
    drawn.done.clear()
    parts = shards(options, count)
    if together:  # all write into one folder
        parts = [dataclasses.replace(o, out=tmp_path / "shared") for o in parts]
    for o in reversed(parts):
        carry_out(drawn.PROGRAM, o)
        assert count == 1 or not (o.out / "results.json").exists()
    assert sorted(drawn.done) == NAMES
    merge.main(tuple(dict.fromkeys(o.out for o in parts)), options.out)
    assert result(options.out) == expected
    before = (options.out / "results.json").read_bytes()
    merge.main(tuple(dict.fromkeys(o.out for o in parts)), options.out)  # again, over itself
    assert (options.out / "results.json").read_bytes() == before


def test_workers_begin_with_the_largest_chunk_which_changes_no_result(options, drawn, monkeypatch, tmp_path):
    shutil.rmtree(options.data / NAMES[4])
    write_published(options.data / NAMES[4], known_scene(points=512))
    carry_out(drawn.PROGRAM, options)
    teams = []
    monkeypatch.setattr(program, "team_of", lambda maker, o: teams.append(Inline(maker)) or teams[-1])
    elsewhere = dataclasses.replace(options, out=tmp_path / "elsewhere", workers=1, scene_minutes=5.0)
    carry_out(drawn.PROGRAM, elsewhere)
    assert [*map(list, teams[0].tasks)] == [NAMES[4:6], NAMES[:2], NAMES[2:4], NAMES[6:]]
    here, there = (json.loads((o.out / "results.json").read_text()) for o in (options, elsewhere))
    assert there["rows"] == here["rows"]
    with pytest.raises(ValueError, match="--scene-minutes 5; needed --workers or --ray"):
        carry_out(drawn.PROGRAM, dataclasses.replace(elsewhere, workers=0))


def test_merging_needs_neither_data_nor_weights(options, drawn, tmp_path):
    parts = shards(options, 2)
    for o in parts:
        carry_out(drawn.PROGRAM, o)
    (tmp_path / "data").rename(tmp_path / "gone")
    (tmp_path / "tiny.npz").unlink()
    merge.main(tuple(o.out for o in parts), options.out)
    assert json.loads((options.out / "results.json").read_text())["rows"][0]["scenes"] == len(NAMES)


@pytest.mark.parametrize("count", range(1, 9))
@pytest.mark.parametrize("chunk", [1, 2, 3, 10])
def test_every_scene_is_in_one_shard_and_its_batch_is_the_same(tmp_path, count, chunk):
    o = Options(data=tmp_path, out=tmp_path, chunk=chunk)
    current = RunFolder(out=tmp_path, names=tuple(NAMES), settings={}, right_deg=5.0)
    whole = unfinished_chunks(current, o)
    parts = [unfinished_chunks(current, s) for s in shards(o, count)]
    assert sorted(tuple(c) for part in parts for c in part) == sorted(map(tuple, whole))
    assert sorted(n for part in parts for c in part for n in c) == NAMES


def test_a_chunk_begun_is_computed_whole_and_what_is_there_stays(options, drawn):
    carry_out(drawn.PROGRAM, options)
    files = {n: options.out / "scenes" / f"{n}.json" for n in NAMES}
    files["scene_2"].unlink()
    files["scene_3"].write_text("[]")
    drawn.done.clear()
    carry_out(drawn.PROGRAM, options)
    assert drawn.done == ["scene_2", "scene_3"]
    assert files["scene_3"].read_text() == "[]" and len(json.loads(files["scene_2"].read_text())) == 3


def refused(capsys, *words):
    """The one line of `python -m eval.merge` that ends with exit code 2."""
    sys.argv = ["eval.merge", *map(str, words)]
    with pytest.raises(SystemExit) as stopped:
        merge.run(merge.main)
    assert stopped.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_what_is_missing_or_does_not_belong_is_one_line(options, drawn, capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "argv", sys.argv)  # `refused` sets it
    one, two = shards(options, 2)
    carry_out(drawn.PROGRAM, one)
    out = ["--out", tmp_path / "merged"]
    capsys.readouterr()
    line = refused(capsys, one.out, *out)
    assert "3 of 7 scenes missing (scene_2, scene_3, scene_6); there are shards 1/2" in line
    carry_out(drawn.PROGRAM, dataclasses.replace(two, preset="paper"))
    capsys.readouterr()
    line = refused(capsys, one.out, two.out, *out)
    assert f"{two.out} (shard 2/2) has other config, preset than {one.out}; needed one run" in line
    carry_out(drawn.PROGRAM, dataclasses.replace(two, batch=4, fresh=True))
    capsys.readouterr()
    assert "has other batch than" in refused(capsys, one.out, two.out, *out)
    assert "no run of a program of eval" in refused(capsys, tmp_path / "data", *out)
    assert not (tmp_path / "merged").exists()


@pytest.mark.parametrize("text", ["", "2", "0/2", "3/2", "1/0", "a/b", "-1/2", "1/2/3"])
def test_no_shard(text):
    with pytest.raises(ValueError, match=r"--shard .*; needed i/n with 1 ≤ i ≤ n, such as 2/8"):
        shard_of(text)


def test_hosts_are_told_what_took_the_place_of_distributed(monkeypatch):
    from eval.harness.program import run_program

    monkeypatch.setattr(sys, "argv", ["eval.matching", "--distributed"])
    with pytest.raises(SystemExit, match=r"--distributed is gone: .*--shard i/n"):
        run_program(matching.main)


def test_a_real_program_in_shards(options, tmp_path):
    """Everything but measured seconds is the same to the bit."""
    o = matching.Settings(**{**dataclasses.asdict(options), "preset": "paper", "batch": 4})
    matching.main(o)
    parts = shards(o, 2)
    for part in parts:
        matching.main(part)
    merge.main(tuple(p.out for p in parts), tmp_path / "merged")
    rows = [
        [r for r in json.loads((out / "results.json").read_text())["rows"] if r["unit"] != "s"]
        for out in (o.out, tmp_path / "merged")
    ]
    assert rows[0] == rows[1] and len(rows[0]) > 20


@pytest.mark.slow
@pytest.mark.optimized  # as the workers compile
@pytest.mark.parametrize("where", [{"workers": 2}, {"ray": "local", "workers": 1}], ids=["processes", "ray"])
def test_workers_give_the_same(options, tmp_path, monkeypatch, where):
    """Other processes, the actors of a cluster: the files of scenes are those of this process, but for seconds."""
    if "ray" in where:
        pytest.importorskip("ray")
        monkeypatch.setenv("RAY_worker_niceness", "0")
    monkeypatch.setenv("JAX_DEFAULT_MATMUL_PRECISION", "highest")  # as in this process
    o = matching.Settings(**{**dataclasses.asdict(options), "preset": "paper", "batch": 4, **where})
    matching.main(o)
    matching.main(dataclasses.replace(o, out=tmp_path / "alone", workers=0, ray=None))

    def told(out):
        files = sorted((out / "scenes").glob("*.json"))
        return {f.name: [r | {"seconds": 0} for r in json.loads(f.read_text())] for f in files}

    assert told(o.out) == told(tmp_path / "alone") and len(told(o.out)) == len(NAMES)
