"""Whether pages keep to the style of `prose_style.yaml`: proselint with a few checks of our own, and codespell.

`python -m docs_build.prose` checks the pages that the style names, or those that are given.
"""

from __future__ import annotations

import contextlib
import functools
import io
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import codespell_lib
import proselint.checks
import tyro
import yaml
from proselint.registry import CheckRegistry
from proselint.registry.checks import Check, CheckResult, Padding
from proselint.registry.checks.types import Existence

from more2_jax.config import from_dict

ROOT = Path(__file__).parents[1]
# What is no prose: tables that `eval.docs_figures` makes, code, comments, tags, addresses of links, front matter.
FIGURES = re.compile(r"^<!-- figures: .*?<!-- end of figures -->", re.MULTILINE | re.DOTALL)
FENCED = re.compile(r"^(`{3,}|~{3,}).*?^\1", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`[^`\n]*(?:\n[^`\n]+)?`")
NO_PROSE = re.compile(r"<!--.*?-->|<[^>\n]+>|\]\([^)]*\)|https?://\S+|\A---\n.*?\n---\n", re.DOTALL)
# A line break inside a paragraph: what follows is no list, heading, row, quotation, admonition or blank line.
SOFT_BREAK = re.compile(r"(?<=[^\n])\n(?=[ \t]*[^\s\-*+#|>!\d])|(?<=[^\n])\n(?=[ \t]*\d+[^.\d)])")
SENTENCE = re.compile(r".+?(?:[.!?](?=\s+[^a-z\s])|$)", re.MULTILINE)
WORD = re.compile(r"\w[\w'’/.-]*")


@dataclass(frozen=True)
class Style:
    """What `prose_style.yaml` holds."""

    pages: tuple[str, ...]
    longest_sentence_words: int
    longest_page_words: int
    diary: tuple[str, ...]
    proselint_off: tuple[str, ...]


def read_style() -> Style:
    """The style of this repository."""
    text = (Path(__file__).parent / "prose_style.yaml").read_text(encoding="utf-8")
    return from_dict(Style, yaml.safe_load(text), where="prose_style.yaml")


def pages_of(style: Style) -> list[Path]:
    """The pages that the style names; folders that are not there have none."""
    found = []
    for name in style.pages:
        path = ROOT / name
        found += sorted(path.rglob("*.md")) if path.is_dir() else [path] * path.is_file()
    return found


def prose_of(text: str) -> str:
    """The text with everything else blanked out, as long as before; a paragraph is one line."""
    for no_prose in (FIGURES, FENCED):
        text = no_prose.sub(lambda m: re.sub(r"[^\n]", " ", m[0]), text)
    text = INLINE.sub(lambda m: "X" * len(m[0]), text)  # a word each
    text = NO_PROSE.sub(lambda m: re.sub(r"[^\n]", " ", m[0]), text)
    return SOFT_BREAK.sub(" ", text).replace("|", "\n")


def own_checks(style: Style) -> list[Check]:
    """Diary words, long sentences, long pages."""
    diary = Existence(style.diary, padding=Padding.WORDS_IN_TEXT)

    def sentences(text: str, check: Check) -> Iterator[CheckResult]:
        for m in SENTENCE.finditer(text):
            if (count := len(WORD.findall(m[0]))) > style.longest_sentence_words:
                at = m.start() + len(m[0]) - len(m[0].lstrip())
                yield CheckResult(check.path, f"{check.message} {count} words.", (at, m.end()), None)

    def pages(text: str, check: Check) -> Iterator[CheckResult]:
        if (count := len(WORD.findall(text))) > style.longest_page_words:
            yield CheckResult(check.path, f"{check.message} {count} words.", (0, 0), None)

    most, words = style.longest_sentence_words, style.longest_page_words
    return [
        Check(diary, path="style.diary", message="'{}' is of a notebook; say what is true now."),
        Check(sentences, path="style.sentence", message=f"At most {most} words a sentence, here are"),
        Check(pages, path="style.page", message=f"At most {words} words a page, here are"),
    ]


@functools.cache
def checks_of_proselint() -> list[Check]:
    """Those that are on by default."""
    registry = CheckRegistry()
    registry.register_many(proselint.checks.__register__)
    return registry.get_all_enabled()


def faults(path: Path, style: Style) -> list[str]:
    """What a page has against the style, a line each: file, line, check, message."""
    raw = path.read_text(encoding="utf-8")
    text = f"\n{prose_of(raw)}\n"  # checks look at what stands beside a word
    checks = [c for c in checks_of_proselint() if not any(map(c.matches_partial, style.proselint_off))]
    results = [r for check in (*own_checks(style), *checks) for r in check.check_with_flags(text)]
    return [
        f"{shown(path)}:{raw.count(chr(10), 0, max(r.span[0] - 1, 0)) + 1}: {r.check_path}: {r.message}"
        for r in sorted(results, key=lambda r: r.span)
    ]


def misspelled(paths: list[Path]) -> list[str]:
    """Words that are British or wrong; codespell reads what to pass over from pyproject.toml."""
    printed = io.StringIO()
    arguments = ["--builtin", "clear,en-GB_to_en-US", "--toml", str(ROOT / "pyproject.toml")]
    with contextlib.redirect_stdout(printed):
        codespell_lib.main(*arguments, *map(str, paths))
    return [shown(Path(line)) for line in printed.getvalue().splitlines() if "==>" in line]


def shown(path: Path) -> str:
    """A path as a reader names it."""
    return str(path.relative_to(ROOT)) if path.is_relative_to(ROOT) else str(path)


def main(*pages: tyro.conf.Positional[Path]) -> int:
    """Prints what pages have against the style; returns 1 where there is anything.

    Args:
        pages: those to check; by default those of the style.
    """
    style = read_style()
    paths = [p.resolve() for p in pages] or pages_of(style)
    found = [fault for path in paths for fault in faults(path, style)] + (misspelled(paths) if paths else [])
    print("\n".join([*found, f"{len(paths)} pages, {len(found)} faults"]))
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
