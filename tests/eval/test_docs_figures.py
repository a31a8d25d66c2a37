"""No table of the documentation differs from the figures that runs left behind."""

import json
import re
from pathlib import Path

import pytest

from eval.docs_chart import CHART, REGISTRATION_CHART, RUNS, bars_of, draw, plain, shares_of, shown_in
from eval.docs_figures import BLOCK, FIGURES, commands_of, general, kept_of, main, over_groups, with_tables

DOCS = Path(__file__).parents[2] / "docs"


def row(name, column, method, value, better="higher", group="all"):
    more = dict(unit="%", count=8, failures=0, ci95=[value - 1, value + 1], scenes=2, group=group)
    return dict(name=name, column=column, method=method, value=value, better=better, **more)


RESULTS = {
    "command": "python -m eval.end_to_end --data rooms",
    "date": "2026-11-25T03:48:12+00:00",
    "hardware": "2 cores",
    "versions": {},
    "settings": {},
    "rows": [
        row("MR", "strict", "ours, robust", 80.0),
        row("MR", "strict", "GICP", 70.0),
        row("MR", "strict", "RANSAC", 75.0),
        row("MR", "strict", "ours, robust", 5.0, group="category chair"),
        row("MedRE of true pairs", "strict", "ours, robust", 2.0, "lower"),
        row("MedRE of true pairs", "strict", "GICP", 1.0, "lower"),
        row("something else", "", "GICP", 1.0),
    ],
}
ONE = "<!-- figures: runs = a; show = MR, median RE -->\nold\n<!-- end of figures -->\n"
TWO = ONE.replace("runs = a", "runs = a, b")


@pytest.fixture
def docs(tmp_path):
    for name in "ab":
        folder = tmp_path / "runs" / name
        folder.mkdir(parents=True)
        (folder / "results.json").write_text(json.dumps(RESULTS), encoding="utf-8")
        main(folder, name, tmp_path)
    return tmp_path


def test_every_page_shows_what_is_kept():
    pages = [p for p in DOCS.rglob("*.md") if "<!-- figures:" in p.read_text(encoding="utf-8")]
    assert pages
    for page in pages:
        text = page.read_text(encoding="utf-8")
        assert len(BLOCK.findall(text)) == text.count("<!-- figures:")
        assert with_tables(text, DOCS / "figures") == text, f"{page.name}: `python -m eval.docs_figures`"


def test_what_is_kept_is_shown_somewhere():
    text = "".join(p.read_text(encoding="utf-8") for p in DOCS.rglob("*.md"))
    shown = {n.strip() for m in re.findall(r"<!-- figures: runs = ([^;]*);", text) for n in m.split(",")}
    assert {p.stem for p in (DOCS / "figures").glob("*.json")} == shown


def test_one_run_shows_all_methods_and_the_best_in_bold(docs):
    made = with_tables(ONE, docs / "figures")
    assert "| MR [%] | **80.0** (79.0 to 81.0) | 70.0 (69.0 to 71.0) | 75.0 (74.0 to 76.0) |" in made
    assert "| median RE [%] | 2.00 (1.00 to 3.00) | **1.00** (0.00 to 2.00) |  |" in made
    assert "old" not in made and RESULTS["command"] in made


def test_one_run_of_many_methods_has_a_line_a_method(docs):
    made = with_tables(ONE.replace("median RE", "median RE; lines = methods"), docs / "figures")
    assert "| ours, robust | **80.0** (79.0 to 81.0) | 2.00 (1.00 to 3.00) |" in made
    assert "| RANSAC | 75.0 (74.0 to 76.0) |  |" in made and "| GICP | 70.0" in made
    ours = with_tables(ONE.replace("median RE", "median RE; lines = methods; only = ours"), docs / "figures")
    assert "| ours, robust | **80.0**" in ours and "GICP" not in ours


def test_figures_over_scans_stand_in_one_cell():
    rows = [
        row("coverage", "", m, v + n, group=f"scans {n}")
        for n in (2, 10, 1)
        for m, v in (("ours", 50.0), ("paper", 40.0))
    ]
    rows.append(row("coverage", "", "ours", 99.0))
    rows += [row("MedRE, strict", "", "ours", 1.0 * n, group=f"scans {n}") for n in (10, 2)]
    kept = kept_of(RESULTS | {"command": "python -m eval.accumulation --data rooms", "rows": rows})
    lines = over_groups(kept, ["coverage", "median RE of objects"], "scans")
    assert lines[0] == "| after 1, 2, … scans | coverage [%] | median RE of objects [%] |"
    assert lines[2] == "| ours | 51.0 / 52.0 / 60.0 | – / 2.00 / 10.0 |"
    assert lines[3] == "| paper | 41.0 / 42.0 / 50.0 | – / – / – |"
    assert lines[-1].endswith("2 rooms, 8 objects.")


def test_collections_of_furniture_are_told_apart_beside_the_whole(tmp_path):
    rows = [
        row("MR", "strict", m, v, group=g)
        for m, values in (("ours, robust", (60.0, 50.0, 70.0)), ("GICP", (55.0, 52.0, 58.0)))
        for g, v in zip(("all", "collection kenney", "collection clvrai"), values, strict=True)
    ]
    main(run_of(tmp_path, rows), "a", tmp_path)
    page = "<!-- figures: runs = a; show = MR; by = collection -->\n<!-- end of figures -->"
    lines = with_tables(page, tmp_path / "figures").splitlines()
    assert lines[1] == "| collection | MR | rooms, pairs |"
    assert lines[3:5] == ["| clvrai | **70.0** / 58.0 | 2, 8 |", "| kenney | 50.0 / **52.0** | 2, 8 |"]
    whole = with_tables(page.replace("; by = collection", ""), tmp_path / "figures")
    assert "**60.0**" in whole and "70.0" not in whole
    alone = kept_of(RESULTS | {"rows": rows[:2]})["rows"]
    assert [r["value"] for r in alone] == [60.0]


def run_of(folder, rows):
    run = folder / "run"
    run.mkdir()
    (run / "results.json").write_text(json.dumps(RESULTS | {"rows": rows}), encoding="utf-8")
    return run


def test_a_single_method_has_no_best_and_a_table_says_what_it_counts(docs):
    results = RESULTS | {
        "command": "python -m eval.segmentation --data rooms",
        "rows": [row("AP50, moved", "", "changes", 60.0) | {"scenes": 1}],
    }
    (docs / "runs" / "a" / "results.json").write_text(json.dumps(results), encoding="utf-8")
    main(docs / "runs" / "a", "a", docs)
    mark = ONE.replace("MR, median RE", "AP50 moved")
    one = with_tables(mark, docs / "figures")
    assert "| AP50 moved [%] | 60.0 (59.0 to 61.0) |" in one and "2026-11-25, 1 room." in one
    many = with_tables(mark.replace("moved", "moved; lines = methods"), docs / "figures")
    assert "2026-11-25, 1 room, 8 objects." in many


def test_lines_that_are_no_rivals_have_no_best_and_whole_numbers_all_digits(docs):
    kinds = [row("points", "", f"{n} objects", 1_000 * n) | {"unit": "", "ci95": None} for n in (8, 1_600)]
    results = RESULTS | {"command": "python -m eval.building --data rooms", "rows": kinds}
    (docs / "runs" / "a" / "results.json").write_text(json.dumps(results), encoding="utf-8")
    main(docs / "runs" / "a", "a", docs)
    made = with_tables(ONE.replace("MR, median RE", "points; lines = methods"), docs / "figures")
    assert "|  | points |\n" in made
    assert "| 8 objects | 8,000 |\n| 1600 objects | 1,600,000 |\n" in made
    assert "`python -m eval.building --data rooms`, 2026-11-25.\n" in made


def test_ours_is_the_preset_of_the_run_whatever_its_variants_reach(docs):
    """The first method; the best of its variants would be chosen with the result in view."""
    better = row("MR", "strict", "ours, robust, otherwise", 99.0)
    results = RESULTS | {"rows": [*RESULTS["rows"], better]}
    (docs / "runs" / "a" / "results.json").write_text(json.dumps(results), encoding="utf-8")
    main(docs / "runs" / "a", "a", docs)
    assert "| **80.0** / 75.0 |" in with_tables(TWO, docs / "figures")


def test_several_runs_show_ours_beside_the_best_peer(docs):
    made = with_tables(TWO, docs / "figures")
    assert made.count("| **80.0** / 75.0 | 2.00 / **1.00** | 2, 8 |\n") == 2
    assert made.count("2026-11-25") == 1  # of both
    assert made.count(f"`{RESULTS['command']}") == 1  # rooms of both have no name of their own
    assert with_tables(made, docs / "figures") == made


def test_runs_of_different_days_say_so(docs):
    results = RESULTS | {"date": "2026-11-26T01:00:00+00:00"}
    (docs / "runs" / "b" / "results.json").write_text(json.dumps(results), encoding="utf-8")
    main(docs / "runs" / "b", "b", docs)
    made = with_tables(TWO, docs / "figures")
    assert made.count("| 2, 8 | 2026-11-25 |") == made.count("| 2, 8 | 2026-11-26 |") == 1
    assert made.count("| date |") == 1


def test_options_that_some_runs_have_stand_beside_the_command():
    some = ["python -m p --data D --masks M", "python -m p --data D", "python -m p --data D --upright no"]
    assert commands_of(some) == "`python -m p --data D`, some with `--masks M`, `--upright no`"
    assert commands_of(some[1:2] * 2) == "`python -m p --data D`"
    assert commands_of([some[1], "python -m q --data D"]) == "`python -m p --data D`, `python -m q --data D`"


def test_commands_that_differ_in_names_alone_are_one():
    first = "python -m eval.end_to_end --data rooms/a --out runs/a_cut --scenes 8 --masks cut"
    other = "python -m eval.end_to_end --data rooms/b --out runs/b --scenes 16 --masks merged"
    said = "python -m eval.end_to_end --data rooms/ROOMS --out runs/RUN --scenes SCENES --masks MASKS"
    assert general("a_cut", first) == general("b", other) == said
    assert general("c", first) != said  # a folder that is not the run's stays


@pytest.mark.no_cover
def test_the_chart_of_registration_is_of_the_figures_that_are_kept():
    shares = shares_of(DOCS / "figures")
    assert shares is not None and shares["upright"]["ours, robust"] > shares["upright"]["multi-start GICP"]
    assert shown_in(DOCS / REGISTRATION_CHART) == plain(shares), "`python -m eval.docs_figures`"


def test_a_page_is_written_and_the_rest_of_it_stays(docs):
    (docs / "page.md").write_text(f"before\n{ONE}after {ONE}", encoding="utf-8")
    main(docs=docs)
    text = (docs / "page.md").read_text(encoding="utf-8")
    assert text.startswith("before\n<!--") and text.count("80.0") == 2 and "old" not in text


def test_the_chart_is_of_the_figures_that_are_kept():
    bars = bars_of(DOCS / "figures")
    assert bars is not None and all(len(pairs) == len(RUNS) for pairs in bars.values())
    assert shown_in(DOCS / CHART) == plain(bars), "`python -m eval.docs_figures`"


def test_the_chart_shows_ours_and_the_best_peer_and_is_drawn_anew_where_figures_change(tmp_path):
    (tmp_path / "figures").mkdir()
    rows = [{**r, "name": name} for name in ("instance recall", "MR") for r in RESULTS["rows"][:3]]
    for name in RUNS:
        draw(tmp_path)
        assert not (tmp_path / CHART).exists()
        (tmp_path / "figures" / f"{name}.json").write_text(json.dumps({"rows": rows}), encoding="utf-8")
    draw(tmp_path)
    assert shown_in(tmp_path / CHART)["MR"] == [[80.0, 75.0]] * len(RUNS)
    rows[-1]["value"] = 90.0
    (tmp_path / "figures" / f"{name}.json").write_text(json.dumps({"rows": rows}), encoding="utf-8")
    draw(tmp_path)
    assert shown_in(tmp_path / CHART)["MR"][-1] == [80.0, 90.0]


@pytest.mark.parametrize(
    ("mark", "said"),
    [(ONE.replace("= a", "= c"), "no such figures"), (ONE.replace("MR,", "XY,"), "needed some of")],
)
def test_what_is_not_there_is_refused(docs, mark, said):
    with pytest.raises(ValueError, match=said):
        with_tables(mark, docs / "figures")
    with pytest.raises(ValueError, match="needed --name"):
        main(docs / "runs" / "a", docs=docs)


def test_only_figures_over_all_scenes_are_kept():
    kept = kept_of(RESULTS)["rows"]
    assert {(r["name"], r["column"]) for r in kept} <= set(FIGURES.values())
    assert [r["value"] for r in kept] == [80.0, 70.0, 75.0, 2.0, 1.0]
