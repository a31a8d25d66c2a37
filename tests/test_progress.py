"""Progress: what stages tell, bars on a terminal, one plain line a stage elsewhere, JSON lines by their schema."""

import io
import json
from importlib import resources

import jsonschema
import pytest
from rich.console import Console

from more2_jax.cli.options import Reporting
from more2_jax.cli.session import Session
from more2_jax.progress import Progress, staged

SCHEMA = json.loads((resources.files("more2_jax") / "assets" / "log.schema.json").read_text(encoding="utf-8"))


def meshing(session: Session, objects: int = 2) -> None:
    with staged({}, session.watch, "mesh", objects) as advance:
        for done in range(1, objects + 1):
            advance(done)


def written(path) -> list[dict]:
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    for line in lines:
        jsonschema.validate(line, SCHEMA, format_checker=jsonschema.FormatChecker())
    return lines


def test_a_stage_tells_its_counts_in_order_and_adds_its_seconds():
    told: list[Progress] = []
    timing = {"register": 1.0}
    with staged(timing, told.append, "register", 3, scan="b") as advance:
        advance(2)
    assert [(p.event, p.done, p.total) for p in told] == [
        ("started", 0, 3),
        ("advanced", 2, 3),
        ("finished", 3, 3),
    ]
    assert {(p.stage, p.scan, p.unit) for p in told} == {("register", "b", "pairs")}
    assert told[0].seconds <= told[1].seconds <= told[2].seconds
    assert timing["register"] > 1.0


def test_a_stage_without_anything_to_do_is_silent_but_timed():
    told, timing = [], {}
    with staged(timing, told.append, "joint", 0):
        pass
    assert told == []
    assert timing["joint"] >= 0


def test_a_stage_that_raises_has_no_end():
    told: list[Progress] = []
    with pytest.raises(RuntimeError), staged({}, told.append, "joint", 1):
        raise RuntimeError
    assert [p.event for p in told] == ["started"]


def test_without_a_terminal_there_is_one_plain_line_a_stage():
    screen = io.StringIO()
    with Session(console=Console(file=screen, width=120)) as session:
        meshing(session)
    (line,) = screen.getvalue().splitlines()
    assert line.startswith("meshing the scene: 2 objects, ")
    assert line.isprintable()  # no control characters
    assert session.text().count("meshing the scene: 2 objects") == 1


def test_on_a_terminal_bars_show_counts_and_time_left():
    screen = io.StringIO()
    with Session(console=Console(file=screen, width=120, force_terminal=True), steps=3) as session:
        meshing(session)
    shown = screen.getvalue()
    assert "\x1b[" in shown
    assert "meshing the scene" in shown
    assert "2/2" in shown
    assert "1/3" in shown
    assert "left" in shown


@pytest.mark.parametrize("terminal", [True, False])
def test_quiet_prints_nothing_but_warnings(terminal, capsys):
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=terminal)
    with Session(Reporting(quiet=True), console) as session:
        session.say("read")
        session.warn("odd")
        meshing(session)
    assert screen.getvalue() == ""
    assert capsys.readouterr().err == "warning: odd\n"
    assert [part in session.text() for part in ("read", "odd", "meshing")] == [True] * 3


def test_json_lines_follow_their_schema(tmp_path, capsys):
    path = tmp_path / "log.jsonl"
    with Session(Reporting(quiet=True, log_json=path)) as session:
        session.say("read a.ply")
        session.warn("odd")
        meshing(session)
    lines = written(path)
    assert [line["event"] for line in lines] == [
        "message",
        "warning",
        "started",
        "advanced",
        "advanced",
        "finished",
    ]
    assert [line["done"] for line in lines[2:]] == [0, 1, 2, 2]
    assert (lines[0]["text"], lines[1]["text"]) == ("read a.ply", "odd")


@pytest.mark.parametrize(
    ("error", "event"), [(KeyboardInterrupt("2 kept"), "interrupted"), (ValueError("2 kept"), "failed")]
)
def test_the_end_is_in_the_json_lines(tmp_path, error, event):
    path = tmp_path / "log.jsonl"
    with pytest.raises(type(error)), Session(Reporting(log_json=path)):
        raise error
    (line,) = written(path)
    assert (line["event"], line["text"]) == (event, "2 kept")


@pytest.mark.parametrize(
    "wrong",
    [{"event": "ended"}, {"stage": None}, {"total": 0}, {"done": -1}, {"extra": 1}, {"text": "and words"}],
)
def test_the_schema_refuses_other_lines(tmp_path, wrong):
    with Session(Reporting(quiet=True, log_json=tmp_path / "log.jsonl")) as session:
        meshing(session)
    line = written(tmp_path / "log.jsonl")[0]
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(line | wrong, SCHEMA)


def test_what_is_saved_is_not_saved_again():
    session = Session(Reporting(quiet=True))
    session.say("one")
    assert session.unsaved().endswith("one\n")
    session.say("two")
    assert session.unsaved().endswith("two\n") and session.unsaved() == ""
    assert session.text().count("\n") == 2
