"""Pages that are made from the code name every command, flag, setting, key and public name."""

import dataclasses
import json
import re

import pytest
from places import ROOT

import more2_jax
from docs_build import examples
from docs_build.command_line_page import command_line_page
from docs_build.examples import all_examples, example_pages, stale_examples
from docs_build.hooks import pages_in, section_of
from docs_build.programs_page import programs, programs_page
from docs_build.python_page import python_page
from docs_build.scene_json_page import scene_json_page, schema, table
from docs_build.settings_page import settings_reference
from eval import end_to_end
from more2_jax.cli import main as command_line
from more2_jax.config import preset

DOCS = ROOT / "docs"
PROGRAM = re.compile(r"python -m ((?:train|eval)\.[\w.]+)")


def test_every_command_has_its_section():
    page = command_line_page()
    source = (ROOT / "more2_jax/cli/main.py").read_text(encoding="utf-8")
    names = re.findall(r'\| Annotated\[\w+, subcommand\("(\w+)"\)\]', source) + ["demo"]
    assert len(names) > 10
    for name in (*names, "prior import", "prior check"):
        assert f"## more2 {name}\n```text\nusage: more2 {name} " in page


def test_every_flag_stands_in_the_section_of_its_command():
    section = command_line_page().split("## more2 run\n")[1].split("\n## ")[0]
    for settings in (command_line.Run, command_line.Reading, command_line.Reporting):
        names = {f.name for f in dataclasses.fields(settings)} - {"reading", "reporting", "scans"}
        assert all(f"--{name.replace('_', '-')}" in section for name in names)
    assert "SCAN [SCAN ...]" in section
    assert "\x1b" not in section


def test_every_program_of_a_clone_has_its_section_with_its_flags():
    page = programs_page()
    assert len(programs()) > 30
    for name in programs():
        assert f"## {name}\n```text\nusage: python -m {name} " in page
    flags = dataclasses.fields(end_to_end.Settings)
    section = page.split("## eval.end_to_end\n")[1].split("\n## ")[0]
    assert all(f"--{f.name.replace('_', '-')}" in section for f in flags)
    named = {m for text in DOCS.rglob("*.md") for m in PROGRAM.findall(text.read_text(encoding="utf-8"))}
    assert named - set(programs()) == {"eval.compile_seconds"}  # takes the words of another command


def leaves(settings, where=""):
    """Names and values of settings, as YAML has them."""
    for f in dataclasses.fields(settings):
        value, name = getattr(settings, f.name), f"{where}{f.name}"
        if dataclasses.is_dataclass(value):
            yield from leaves(value, f"{name}.")
        else:
            yield name, value


@pytest.mark.parametrize(("name", "column"), [("paper", 3), ("field", 4), ("robust", 5)])
def test_every_setting_has_its_row_with_the_value_of_the_preset(name, column):
    rows = [
        re.split(r"(?<!\\)\|", line) for line in settings_reference().splitlines() if line.startswith("| `")
    ]
    shown = {(row[1].strip(" `"), row[column].strip(" `")) for row in rows if len(row) > 7}
    for setting, value in leaves(preset(name)):
        assert (setting, str(value).lower() if isinstance(value, bool) else str(value)) in shown


def test_every_row_of_the_settings_has_a_meaning_that_ends_as_a_sentence_does():
    rows = [
        re.split(r"(?<!\\)\|", line) for line in settings_reference().splitlines() if line.startswith("| `")
    ]
    assert len(rows) > 90
    assert [row[1] for row in rows if not re.fullmatch(r"[^a-z].*\.", row[-2].strip())] == []
    assert any(row[1].strip() == "`training.ema`" for row in rows)


def keys(part):
    """Every property of a schema, at any depth, with what it says."""
    if isinstance(part, dict):
        for name, value in part.get("properties", {}).items():
            yield name, value
        for name, value in part.items():
            if name not in ("if", "then", "else"):
                yield from keys(value)
    elif isinstance(part, list):
        for value in part:
            yield from keys(value)


@pytest.mark.parametrize("name", ["scene", "log"])
def test_every_key_of_a_schema_has_a_meaning_and_a_row(name):
    page, found = scene_json_page(), list(keys(schema(name)))
    assert len(found) >= 9
    for key, value in found:
        assert value.get("description"), key
        assert re.search(
            rf"^\| `{key}` \| .* \| {re.escape(value['description'])} \|$", page, re.MULTILINE
        ), key


def test_a_row_says_what_a_value_is():
    record = {
        "required": ["a"],
        "properties": {"a": {"type": ["string", "null"]}, "b": {"$ref": "#/$defs/scan"}},
    }
    rows = table(record).splitlines()[2:]
    assert rows == ["| `a` | string or null | always |  |", "| `b` | [scan](#scan) | where there is any |  |"]


def test_every_public_name_is_on_the_page_of_python():
    shown = [line.rsplit(".", 1)[1] for line in python_page().splitlines() if line.startswith(":::")]
    assert sorted(shown) == sorted(more2_jax.__all__)


def test_outputs_are_of_the_examples_as_they_are():
    assert stale_examples() == [], "python -m docs_build.examples"
    assert json.loads(examples.SOURCES.read_text()).keys() == {e.name for e in all_examples()}
    assert all(e.picture.stat().st_size < 150_000 for e in all_examples())


def test_an_example_has_text_code_output_and_picture():
    pages = example_pages()
    for e in all_examples():
        page = pages[f"examples/{e.name}.md"]
        assert page.startswith(f"# {e.number}. {e.title}\n\n{e.docstring}")
        assert e.title and len(e.title) < 80
        assert f"```python\n{e.code}\n```" in page
        assert f"```text\n{e.output.read_text().rstrip()}\n```" in page
        assert pages[f"examples/{e.picture.name}"][:4] == b"\x89PNG"
        assert f"({e.name}.md)" in pages["examples/index.md"]


def test_a_changed_example_is_refused_until_it_was_run(monkeypatch, tmp_path):
    source = tmp_path / "01_one.py"
    source.write_text('"""One. Two."""\n\nprint(1)\n')
    one = examples.Example(source)
    assert (one.title, one.code) == ("One", "print(1)")
    monkeypatch.setattr(examples, "OUTPUTS", tmp_path)
    monkeypatch.setattr(examples, "SOURCES", tmp_path / "sources.json")
    monkeypatch.setattr(examples, "all_examples", lambda: [one])
    with pytest.raises(ValueError, match="not of the sources of 01_one"):
        example_pages()
    one.output.write_text("1\n")
    one.picture.write_bytes(b"\x89PNG")
    examples.SOURCES.write_text(json.dumps({one.name: one.digest}))
    assert "examples/01_one.md" in example_pages()
    source.write_text('"""One. Two."""\n\nprint(2)\n')
    with pytest.raises(ValueError, match=r"docs_build\.examples"):
        example_pages()


def test_pages_of_a_navigation_are_found_at_any_depth():
    assert pages_in([{"A": [{"B": "b.md"}, "c.md"]}, {"D": "d.md"}]) == ["b.md", "c.md", "d.md"]


def test_a_section_of_the_navigation_is_found_or_made():
    nav = [{"Reference": ["a.md"]}]
    section_of(nav, "Reference").append("b.md")
    section_of(nav, "Examples").append("c.md")
    assert nav == [{"Reference": ["a.md", "b.md"]}, {"Examples": ["c.md"]}]
