"""All tables of some runs on one page.

`python -m eval.report --runs runs/all/* --out runs/results_tables.md`
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eval.harness.paper_numbers import quoted
from eval.harness.results import portable
from eval.harness.tables import best, heading, markdown_table, number
from eval.scores.figures import Row
from train.run.program import run

TITLES = {
    "end_to_end": "End to end",
    "matching": "Matching",
    "registration": "Registration of true pairs",
    "reconstruction": "Reconstruction",
    "accumulation": "Accumulation",
    "ablations": "Ablations",
    "decoding": "Decoding",
}
MAIN_FIGURE = {  # of each program, the one shown by category
    "end_to_end": "MR, strict",
    "registration": "RR, RE < 5°, strict",
    "reconstruction": "Chamfer-L1, strict",
}
HEAD = """# Result tables

Written by `python -m eval.report`; `docs/guides/evaluating.md` says how to make and read them. Intervals are 95 %, by
bootstrap over scenes; "of" is the denominator; a failure counts in it. Bold is best of its line, whoever made it.

- *paper's formula*: as printed. *as published*: as the published code computes it. *strict*: rotations over the
  object's own measured symmetry group, copies interchangeable once each, distances in centimeters.
- A line without one of these names is the same in all columns that differ elsewhere, or has no other form.
- What the paper prints is quoted below our tables. Its data, weights and some of its definitions are others: **the two
  may not be compared**.
"""


@dataclass(frozen=True, kw_only=True)
class Result:
    """One results.json."""

    folder: Path
    content: dict[str, Any]
    rows: list[Row]

    @property
    def program(self) -> str:
        """Which program wrote it."""
        return self.content["settings"]["program"]

    @property
    def data(self) -> str:
        """Data set, regime and orientation."""
        facts = self.content["settings"]["data"]
        turning = {True: ", free rotation", False: ", upright"}.get(facts.get("free"), "")
        return f"{facts['dataset']}, {facts.get('regime', '')}{turning}"


def main(runs: tuple[Path, ...], out: Path = Path("runs/results_tables.md"), note: str = "") -> None:
    """Writes one page with the tables of all runs, by data set and regime.

    Args:
        runs: folders with results.json, or folders of such folders.
        out: the page.
        note: a line about the circumstances, such as what else the machine was doing.
    """
    results = [read_result(f) for f in sorted(find(runs))]
    if not results:
        raise ValueError(
            f"{', '.join(map(str, runs))}: no results.json; needed folders of eval programs' results"
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(page(results, note), encoding="utf-8")
    print(f"{len(results)} results in {out}")


def find(runs: Iterable[Path]) -> set[Path]:
    """Every results.json of an evaluation below the folders."""
    files = {f for folder in runs for f in folder.rglob("results.json")}
    return {f for f in files if "rows" in json.loads(f.read_text())}


def read_result(file: Path) -> Result:
    """One run's figures and their circumstances."""
    content = json.loads(file.read_text())
    rows = [Row(**{**r, "ci95": tuple(r["ci95"]) if r["ci95"] else None}) for r in content["rows"]]
    return Result(folder=file.parent, content=content, rows=rows)


def page(results: Sequence[Result], note: str) -> str:
    """The whole page."""
    parts = [HEAD, f"{note}\n"] if note else [HEAD]
    for data in dict.fromkeys(r.data for r in results):
        parts.append(f"## {data}\n")
        own = [r for r in results if r.data == data]
        for result in sorted(own, key=lambda r: (list(TITLES).index(r.program), str(r.folder))):
            parts.append(section(result))
    return "\n".join(parts)


def section(result: Result) -> str:
    """Circumstances, main table, tables by category and number of scans, where others win, the paper's figures."""
    overall = [r for r in result.rows if r.group == "all"]
    parts = [f"### {title(result)}\n", circumstances(result), "", markdown_table(overall), ""]
    parts += [by_group(result, prefix) for prefix in ("category ", "scans ")]
    if lost := beaten(overall):
        parts += ["Where another method is ahead of ours: " + "; ".join(lost) + ".", ""]
    paper = quoted(result.program, result.content["settings"]["data"]["dataset"])
    return "\n".join([p for p in parts if p is not None] + ([paper, ""] if paper else []))


def title(result: Result) -> str:
    """Program and what sets this run apart."""
    s = result.content["settings"]
    extras = (
        [f"{s['scans']} scan{'s' if s['scans'] > 1 else ''}"] if result.program == "reconstruction" else []
    )
    extras += [f"first {s['visits']} scans"] if s.get("visits") else []
    extras += [f"masks {s['masks']}"] if s["masks"] != "true" else []
    return ", ".join([TITLES[result.program], f"preset {s['preset']}", *extras])


def circumstances(result: Result) -> str:
    """Command, weights, machine and date."""
    c = result.content
    s, versions = c["settings"], ", ".join(f"{k} {v}" for k, v in c["versions"].items() if v)
    command, digest = portable(c["command"].split()), s["data"]["digest"]
    what = f"`{command}`; weights {s['prior']} ({s['weights']}), data {digest}"
    return f"{what}; {c['hardware']}; {versions}; {c['date'][:10]}"


def by_group(result: Result, prefix: str) -> str | None:
    """One figure over categories or numbers of scans: a line a method."""
    rows = [r for r in result.rows if r.group.startswith(prefix)]
    if prefix == "category ":
        rows = [r for r in rows if heading(r).split(" [")[0] == MAIN_FIGURE.get(result.program)]
    if not rows:
        return None
    groups = sorted({r.group for r in rows})
    found = {(heading(r), r.method, r.group): r for r in rows}
    lines = ["| figure | method | " + " | ".join(g.removeprefix(prefix) for g in groups) + " |"]
    lines.append("|---" * (len(groups) + 2) + "|")
    for name, method in dict.fromkeys((heading(r), r.method) for r in rows):
        own = [found.get((name, method, g)) for g in groups]
        cells = ["" if r is None else f"{number(r.value)} (of {r.count})" for r in own]
        lines.append(f"| {name} | {method} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])


def beaten(rows: Sequence[Row]) -> list[str]:
    """Figures whose best method is not ours."""
    found = []
    for name in dict.fromkeys(heading(r) for r in rows):
        own = [r for r in rows if heading(r) == name]
        tops = [r for r in own if id(r) in best(own)]
        ours = [r for r in own if r.method.startswith(("ours", "Λ", "1 / E"))]
        if ours and tops and not any(r in ours for r in tops):
            found.append(f"{name} ({tops[0].method})")
    return found


if __name__ == "__main__":
    run(main)
