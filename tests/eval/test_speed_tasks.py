"""Ratios are those of seconds, each task's own; too few rooms is one line."""

import json

import pytest

from eval.performance.stopwatch import Seconds
from eval.speed_tasks import OURS, first_rooms, printed, ratios, rows_of


def test_every_task_is_compared_with_ours_in_the_same_task():
    found = {
        ("a", OURS): Seconds(2.0, 4.0),
        ("a", "peer"): Seconds(1.0, 1.0),
        ("b", "peer"): Seconds(30.0, 50.0),
        ("b", OURS): Seconds(10.0, 5.0),
    }
    rows = {(r["task"], r["who"]): (r["wall_ratio"], r["cpu_ratio"]) for r in ratios(found)}
    assert rows == {
        ("a", OURS): (1, 1),
        ("a", "peer"): (0.5, 0.25),
        ("b", "peer"): (3, 10),
        ("b", OURS): (1, 1),
    }
    counts = {"a": 16, "b": 2}
    assert printed(ratios(found), counts).row_count == 4
    kept = {(r.name, r.method, r.column): r for r in rows_of(found, counts, 2)}
    assert {k: r.value for k, r in kept.items() if k[0] == "a"} == {
        ("a", OURS, "wall"): 2,
        ("a", OURS, "processor"): 4,
        ("a", "peer", "wall"): 1,
        ("a", "peer", "processor"): 1,
    }
    assert {(r.name, r.count, r.scenes) for r in kept.values()} == {("a", 16, 2), ("b", 2, 2)}


def test_fewer_rooms_than_asked_for_are_an_error_that_says_both(tmp_path):
    (tmp_path / "scene_0000").mkdir()
    (tmp_path / "scene_0000" / "scene.json").write_text(json.dumps({"regime": "sparse"}))
    with pytest.raises(ValueError, match="1 rooms; needed 3"):
        first_rooms(tmp_path, 3)
