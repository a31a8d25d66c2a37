"""Figures from records: every statistic by hand, failures in every denominator, intervals over scenes, tables."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import tyro

from eval import registration
from eval.harness.results import portable, words_of
from eval.harness.tables import best, latex, markdown, markdown_table, number
from eval.scores.figures import Figure, figure_row, in_columns, mean_ci95, rows_of

A = {"one": [{"method": "m", "e": 1.0}, {"method": "m", "e": 9.0}], "two": [{"method": "m", "e": None}]}


def figure(statistic, **more):
    return Figure(name="f", key="e", statistic=statistic, **more)


def value(statistic, records=A, **more):
    row = figure_row(figure(statistic, **more), records, "m", "all")
    assert row is not None
    return row


@pytest.mark.parametrize(
    ("statistic", "settings", "expected"),
    [
        ("share", {"limit": 5.0}, 1 / 3),  # the failure is below nothing
        ("share", {"limit": 9.0}, 1 / 3),
        ("share", {"limit": 0.0}, 0),
        ("at_least", {"limit": 9.0}, 1 / 3),
        ("mean", {}, 5),
        ("median", {"better": "lower"}, 9),
        ("median", {"better": "higher"}, 1),
    ],
)
def test_statistics_by_hand(statistic, settings, expected):
    row = value(statistic, **settings)
    assert row.value == pytest.approx(expected)
    assert (row.count, row.failures, row.scenes) == (3, 1, 2)


def test_all_right_is_one_and_all_failed_is_zero_or_nothing():
    good, bad = {"s": [{"e": 0.0}] * 3}, {"s": [{"e": None}] * 3}
    assert value("share", good, limit=5.0).value == 1
    assert value("share", bad, limit=5.0).value == 0
    assert value("median", bad, better="lower").value is None
    assert value("mean", bad).value is None
    assert value("median", {"s": [{"e": 1.0}, {"e": None}]}, better="lower").value is None


def test_ratio_is_of_sums_and_counts_what_it_divides_by():
    records = {"a": [{"e": 1, "n": 4}], "b": [{"e": 5, "n": 6}]}
    row = value("ratio", records, over="n", scale=100)
    assert row.value == pytest.approx(60) and row.count == 10


def test_only_successes_where_asked():
    records = {"s": [{"e": 1.0, "r": 2.0}, {"e": 50.0, "r": 90.0}, {"e": None, "r": None}]}
    row = value("median", records, better="lower", successes=("r", 5.0))
    assert (row.value, row.count, row.failures) == (1.0, 1, 0)


def test_a_figure_without_records_is_left_out():
    assert figure_row(figure("mean"), {"s": [{"other": 1.0}]}, "m", "all") is None


def test_intervals_resample_scenes_not_records():
    # Records of a scene are alike: the interval is that of 40 scenes, as the normal distribution has it.
    rng = np.random.default_rng(0)
    level = rng.normal(size=40)
    records = {str(k): [{"e": float(v)}] * 25 for k, v in enumerate(level)}
    low, high = value("mean", records).ci95
    half = 1.96 * level.std() / np.sqrt(40)
    assert low == pytest.approx(level.mean() - half, abs=0.08)
    assert high == pytest.approx(level.mean() + half, abs=0.08)
    median = value("median", records, better="lower").ci95
    assert median[0] < np.median(level) < median[1]


def test_interval_of_a_ratio_by_a_plain_bootstrap():
    rng = np.random.default_rng(1)
    n = rng.integers(3, 9, 30)
    right = rng.binomial(n, 0.7)
    records = {str(k): [{"e": int(r), "n": int(m)}] for k, (r, m) in enumerate(zip(right, n, strict=True))}
    slow = []
    for _ in range(3000):
        chosen = rng.integers(0, 30, 30)
        slow.append(sum(right[c] for c in chosen) / sum(n[c] for c in chosen))
    assert value("ratio", records, over="n").ci95 == pytest.approx(
        np.quantile(slow, [0.025, 0.975]), abs=0.02
    )


def test_bootstrap_interval_agrees_with_the_normal_one():
    values = np.random.default_rng(4).normal(5, 2, size=400)
    low, high = mean_ci95(values)
    error = 1.96 * values.std() / math.sqrt(400)
    assert low == pytest.approx(values.mean() - error, abs=0.05)
    assert high == pytest.approx(values.mean() + error, abs=0.05)


def test_interval_of_a_mean_of_constants_of_one_and_of_nothing():
    assert mean_ci95([2.0, 2.0]) == mean_ci95([2.0]) == (2, 2)
    assert all(map(math.isnan, mean_ci95([])))


def test_no_interval_of_one_scene_nor_of_failures():
    assert value("mean", {"s": [{"e": 1.0}, {"e": 2.0}]}).ci95 is None
    assert value("median", {"a": [{"e": 1.0}], "b": [{"e": None}]}, better="lower").ci95 is None


def test_rows_by_method_and_group():
    records = {
        "s": [
            {"method": m, "category": c, "e": v}
            for m, v in (("x", 1.0), ("y", 3.0))
            for c in ("chair", "table")
        ]
    }
    rows = rows_of([figure("mean")], records, ["category"])
    assert [(r.method, r.group, r.count) for r in rows] == [
        (m, g, n) for m in "xy" for g, n in (("all", 2), ("category chair", 1), ("category table", 1))
    ]


def test_tables_show_value_interval_failures_and_the_best_in_bold():
    records = {
        k: [{"method": "a_b", "e": 1.0}, {"method": "c", "e": 2.0 if k == "1" else None}] for k in "12"
    }
    rows = rows_of([figure("mean", better="lower", column="strict", unit="%")], records)
    text = markdown(rows, "title")
    assert "| f, strict [%] | 2 | **1 (1 to 1)** | 2; 1 failed |" in text
    tex = latex(rows, "title")
    assert r"f, strict [\%] & 2 & \textbf{1 (1 to 1)} & 2; 1 failed \\" in tex and r"a\_b" in tex
    assert {r.method for r in rows if id(r) in best(rows)} == {"a_b"}
    assert best(rows[:1]) == set()


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (0.0, "0"), (0.01234, "0.0123"), (99.44, "99.4"), (100.0, "100"), (4321, "4321")],
)
def test_numbers(value, text):
    assert number(value) == text


def test_columns_that_say_the_same_share_a_line():
    one = {"s": [{"method": "m", "e.paper": 1.0, "e.published": 1.0, "e.strict": 1.0}]}
    other = {"s": [{"method": "m", "e.paper": 1.0, "e.published": 1.0, "e.strict": 2.0}]}
    both = [rows_of(in_columns(figure("mean")), records) for records in (one, other)]
    assert [len(markdown_table(rows).splitlines()) - 2 for rows in both] == [1, 3]
    assert "| f | 1 | 1 |" in markdown_table(both[0]) and "| f, strict | 1 | 2 |" in markdown_table(both[1])


def test_the_command_of_a_run_is_read_back_as_its_options():
    asked = registration.Settings(
        data=Path("here/rooms"), out=Path("there"), scenes=3, peers=False, preset="paper", fresh=True
    )
    words = words_of(asked, "registration")
    assert words[:3] == ["python", "-m", "eval.registration"]
    assert {w for w in words if w.startswith("--")} == {
        "--data",
        "--out",
        "--scenes",
        "--no-peers",
        "--preset",
    }
    assert tyro.cli(registration.Settings, args=words[3:]) == dataclasses.replace(asked, fresh=False)
    assert portable(["--data", "/far/away/rooms", "3"]) == "--data rooms 3"
