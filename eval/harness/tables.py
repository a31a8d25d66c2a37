"""Rows of figures as tables: one line a method, one column a figure, the columns of paper §4 kept apart."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from rich.box import SIMPLE
from rich.markup import escape
from rich.table import Table

from eval.scores.figures import Row

COLUMN_NAMES = {"paper": "paper's formula", "published": "as published", "strict": "strict", "": ""}


def heading(row: Row) -> str:
    """A figure's name with its column and unit."""
    named = f"{row.name}, {COLUMN_NAMES[row.column]}" if row.column else row.name
    return f"{named} [{row.unit}]" if row.unit else named


def number(value: float | None) -> str:
    """Three significant digits; a dash where more than half are failures or nothing has a value."""
    if value is None:
        return "–"
    return f"{value:.0f}" if abs(value) >= 99.95 else f"{value:.3g}"


def cell(row: Row | None) -> str:
    """Value, interval and, where there are any, failures of the denominator."""
    if row is None:
        return ""
    text = number(row.value)
    if row.ci95 is not None:
        text += f" ({number(row.ci95[0])} to {number(row.ci95[1])})"
    return f"{text}; {row.failures} failed" if row.failures else text


def best(rows: Iterable[Row]) -> set[int]:
    """Which rows (by id) hold the best value of one figure among methods."""
    with_value = [r for r in rows if r.value is not None]
    if len(with_value) < 2:
        return set()
    pick = max if with_value[0].better == "higher" else min
    top = pick(r.value for r in with_value if r.value is not None)
    return {id(r) for r in with_value if r.value == top}


def layout(rows: Sequence[Row]) -> tuple[list[str], list[str], dict[tuple[str, str], Row]]:
    """Figures (with their denominators), methods, and the row of each pair."""
    headings = list(dict.fromkeys(heading(r) for r in rows))
    methods = list(dict.fromkeys(r.method for r in rows))
    return headings, methods, {(heading(r), r.method): r for r in rows}


def grid(rows: Sequence[Row]) -> tuple[list[str], list[list[str]], list[list[bool]]]:
    """Titles, text and boldness: a line a figure, a column a method; the denominator stands second."""
    headings, methods, found = layout(rows)
    text, bold = [], []
    for name in headings:
        line = [found.get((name, m)) for m in methods]
        top = best(r for r in line if r is not None)
        counts = sorted({r.count for r in line if r is not None})
        text.append([name, "/".join(map(str, counts)), *(cell(r) for r in line)])
        bold.append([False, False, *(id(r) in top for r in line)])
    text, bold = without_repeats(rows, text, bold)
    return ["figure", "of", *methods], text, bold


def without_repeats(
    rows: Sequence[Row], text: list[list[str]], bold: list[list[bool]]
) -> tuple[list[list[str]], list[list[bool]]]:
    """One line, without a column's name, for a figure whose every column says the same."""
    plain = {heading(r): heading(replace(r, column="")) for r in rows}
    alike: dict[str, list[int]] = {}
    for k, line in enumerate(text):
        alike.setdefault(plain[line[0]], []).append(k)
    kept_text, kept_bold = [], []
    for name, lines in alike.items():
        same = len(lines) > 1 and all(text[k][1:] == text[lines[0]][1:] for k in lines)
        for k in lines[:1] if same else lines:
            kept_text.append([name, *text[k][1:]] if same else text[k])
            kept_bold.append(bold[k])
    return kept_text, kept_bold


def markdown(rows: Sequence[Row], title: str) -> str:
    """A section with a table for every group of records, the best of each line in bold."""
    parts = [f"## {title}", ""]
    for group in dict.fromkeys(r.group for r in rows):
        own = [r for r in rows if r.group == group]
        scenes = max(r.scenes for r in own)
        parts += [f"### {group} ({scenes} scenes)", "", markdown_table(own), ""]
    return "\n".join(parts)


def markdown_table(rows: Sequence[Row]) -> str:
    """One table."""
    titles, text, bold = grid(rows)
    lines = ["| " + " | ".join(titles) + " |", "|" + "---|" * len(titles)]
    for line, strong in zip(text, bold, strict=True):
        cells = [f"**{t}**" if b else t for t, b in zip(line, strong, strict=True)]
        lines.append("| " + " | ".join(c.replace("|", "\\|") for c in cells) + " |")
    return "\n".join(lines)


LATEX = {
    "&": r"\&",
    "%": r"\%",
    "_": r"\_",
    "#": r"\#",
    "°": r"$^\circ$",
    "Λ": r"$\Lambda$",
    "⊘": r"$\oslash$",
}
LATEX |= {"≥": r"$\geq$", "<": "$<$", ">": "$>$", "–": "--", "²": "$^2$", "×": r"$\times$", "τ": r"$\tau$"}


def tex(text: str) -> str:
    """Escaped."""
    return "".join(LATEX.get(c, c) for c in text)


def latex(rows: Sequence[Row], title: str) -> str:
    """The same tables for LaTeX with booktabs."""
    parts = [f"% {title}"]
    for group in dict.fromkeys(r.group for r in rows):
        titles, text, bold = grid([r for r in rows if r.group == group])
        parts += [
            r"\begin{table}",
            rf"\caption{{{tex(title)}: {tex(group)}}}",
            rf"\begin{{tabular}}{{l{'r' * (len(titles) - 1)}}}",
            r"\toprule",
            " & ".join(map(tex, titles)) + r" \\",
            r"\midrule",
        ]
        for line, strong in zip(text, bold, strict=True):
            cells = [rf"\textbf{{{tex(t)}}}" if b else tex(t) for t, b in zip(line, strong, strict=True)]
            parts.append(" & ".join(cells) + r" \\")
        parts += [r"\bottomrule", r"\end{tabular}", r"\end{table}", ""]
    return "\n".join(parts)


def on_screen(rows: Sequence[Row], title: str) -> Table:
    """Values alone, for a terminal; intervals and failures stand in the files."""
    headings, methods, found = layout(rows)
    table = Table("figure", *methods, title=title, box=SIMPLE)
    for name in headings:
        line = [found.get((name, m)) for m in methods]
        top = best(r for r in line if r is not None)
        shown = ["" if r is None else number(r.value) for r in line]
        table.add_row(
            escape(name), *(f"[bold]{t}[/]" if id(r) in top else t for t, r in zip(shown, line, strict=True))
        )
    return table
