"""The check of prose finds what it is for, where it stands, and passes over code."""

import pytest
from places import ROOT

from docs_build.prose import faults, main, misspelled, pages_of, read_style

STYLE = read_style()
LONG = "This sentence " + "goes on and " * 12 + "ends."
BAD = f"""# A page

It is plain here.
It turned out that all is
well. Before the packages, things stood elsewhere.

```text
yesterday {LONG}
```
- {LONG}
- The color of `yesterday` is a setting.

| a cell | of yesterday |
|---|---|
"""
GOOD = """# A page

The library finds every object again. `more2 run` writes a folder, and `before the packages` is code.
A second line of the same paragraph is short.

- One thing.
- Another thing, with [a link](https://example.org/previously/yesterday.html).
"""


@pytest.fixture
def page(tmp_path):
    def write(text):
        path = tmp_path / "page.md"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_what_must_fail_fails_in_its_line(page):
    found = [fault.split(":", 3)[1:3] for fault in faults(page(BAD), STYLE)]
    assert found == [
        ["4", " style.diary"],
        ["5", " style.diary"],
        ["10", " style.sentence"],
        ["13", " style.diary"],
    ]


def test_plain_text_passes(page):
    path = page(GOOD)
    assert faults(path, STYLE) == []
    assert misspelled([path]) == []
    assert main(path) == 0


def test_british_and_wrong_spelling_is_found(page):
    found = misspelled([page("The colour of the neighbouring chair is\nrecieved.\n")])
    assert [line.rsplit(": ", 1)[1] for line in found] == [
        "colour ==> color",
        "neighbouring ==> neighboring",
        "recieved ==> received",
    ]


def test_proselint_speaks_too(page):
    assert any("archaism" in fault for fault in faults(page("It stays so for ever.\n"), STYLE))


def test_a_long_page_is_found(page):
    assert STYLE.longest_page_words == 1500
    assert "style.page" in faults(page("A short sentence. " * 501), STYLE)[0]
    assert faults(page("A short sentence. " * 499), STYLE) == []


def test_tables_that_programs_make_are_passed_over(page):
    made = f"<!-- figures: runs = a; show = MR -->\n| yesterday | {LONG} |\n<!-- end of figures -->\n"
    assert faults(page(f"A page.\n\n{made}\nIt is short.\n"), STYLE) == []
    assert len(faults(page(f"A page.\n\n{made}\nIt was {LONG}\n"), STYLE)) == 1


def test_the_program_says_so(page, capsys):
    assert main(page(BAD)) == 1
    assert capsys.readouterr().out.splitlines()[-1] == "1 pages, 4 faults"


def test_the_scope_is_the_pages_that_people_read():
    scope = {str(p.relative_to(ROOT)) for p in pages_of(STYLE)}
    pages = {str(p.relative_to(ROOT)) for p in (ROOT / "docs").rglob("*.md")}
    apart = {p for p in pages if "/notebook/" in p or "/reference/" in p}  # history, and what programs write
    assert scope == pages - apart | {"README.md", "CHANGELOG.md", "CONTRIBUTING.md"}


def test_ci_runs_it():
    assert "-m docs_build.prose" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")
