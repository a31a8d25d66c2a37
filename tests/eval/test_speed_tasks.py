"""Ratios are those of seconds, each task's own; too few rooms is one line."""

import json

import pytest

from eval.performance.stopwatch import Seconds
from eval.speed_tasks import OURS, first_rooms, printed, ratios


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
    assert printed(ratios(found)).row_count == 4


def test_fewer_rooms_than_asked_for_are_an_error_that_says_both(tmp_path):
    (tmp_path / "scene_0000").mkdir()
    (tmp_path / "scene_0000" / "scene.json").write_text(json.dumps({"regime": "sparse"}))
    with pytest.raises(ValueError, match="1 rooms; needed 3"):
        first_rooms(tmp_path, 3)
