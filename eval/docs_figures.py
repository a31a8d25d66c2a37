"""Tables and the chart of the documentation, made from what runs left behind: no figure is typed.

`python -m eval.docs_figures --keep runs/e2e_cut --name real_cut` stores the figures of a run in docs/figures;
`python -m eval.docs_figures` makes the tables of every page and the README's chart anew. A page says where one belongs:

    <!-- figures: runs = real_cut, real_mix; show = recall, MR -->
    <!-- end of figures -->

One run: a line a figure, with intervals, a column a method; with `; lines = methods` the other way round, for runs of
many methods. Several: a line a run, ours / the best peer. With `; by = collection` a line a collection of furniture of
one run, in the same form. With `; over = scans` a line a method of one run, and in every cell the figure after each
number of scans.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eval.docs_chart import draw
from eval.harness.options import OURS
from eval.scores.told_chances import FIGURES as CHANCES
from train.run.program import run

DOCS = Path("docs")
BLOCK = re.compile(r"(<!-- figures: (?P<what>[^>]*?) -->\n).*?(<!-- end of figures -->)", re.DOTALL)
# What a page calls a figure, and its name and column in results.json.
FIGURES = {
    "recall": ("instance recall", "strict"),
    "MR": ("MR", "strict"),
    "MR, paper's formula": ("MR", "paper"),
    "MRR": ("MRR", "strict"),
    "F1": ("added and removed, F1", ""),
    "told as changed without a mask": ("told as changed without a mask", ""),
    "told whether it moved": ("told whether it moved", "strict"),
    **{f.name.replace(",", ""): (f.name, "") for f in CHANCES},
    "t-mAP": ("t-mAP", ""),
    "t-AP50": ("t-AP50", ""),
    "median RE": ("MedRE of true pairs", "strict"),
    "below 5°": ("RR, RE < 5°", "strict"),
    "below 10°": ("RE < 10°", "strict"),
    "median RE of pairs": ("MedRE", "strict"),
    "within 5 cm": ("within 5 cm", "strict"),
    "RE < 5°": ("RE < 5°", "strict"),
    "coverage": ("coverage", ""),
    "median RE of objects": ("MedRE, strict", ""),
    "Chamfer-L1 of objects": ("Chamfer-L1", ""),
    "IoU of objects": ("IoU", ""),
    "mean RE": ("mean RE", "strict"),
    "median Chamfer-L1": ("median Chamfer-L1", "strict"),
    "Chamfer-L1": ("Chamfer-L1", "strict"),
    "accuracy": ("accuracy", "strict"),
    "completeness": ("completeness", "strict"),
    "F at 1 %": ("F at 1 % of the diagonal", "strict"),
    "SDF recall": ("SDF recall, objects", "strict"),
    "IoU": ("IoU", "paper"),
    "published IoU": ("IoU", "published"),
    "AP50 moved": ("AP50, moved", ""),
    "AP50 moved labeled": ("AP50, moved, labeled", ""),
    "AP50 all": ("AP50, all", ""),
    "AP50 all labeled": ("AP50, all, labeled", ""),
    "recall moved": ("recall, moved", ""),
    "recall all": ("recall, all", ""),
    "registration of the pairs": ("registration of the pairs", "processor"),
    "one room": ("one room", "processor"),
    "all rooms": ("all rooms", "processor"),
    "drawn in full": ("drawn in full", ""),
    "a frame while the mouse drags": ("a frame while the mouse drags", ""),
    "a frame while objects glide": ("a frame while objects glide", ""),
    "file": ("file", ""),
    "points": ("points", ""),
    "all stages": ("processor time", ""),
    "peak memory": ("peak memory", ""),
    "right pairs": ("right pairs", ""),
    "moments": ("moments", ""),
    "right moments": ("right moments", ""),
    "sign": ("sign", ""),
    "L1 of uniform queries": ("L1 of uniform queries", ""),
    "L1 near the surface": ("L1 near the surface", ""),
    "Chamfer-L1 at the observed level": ("Chamfer-L1 at the observed level", ""),
    "error of distances": ("error of distances", ""),
    "overlap": ("overlap", ""),
    "orientation": ("orientation", ""),
    "change of distances": ("change of distances", ""),
    "change of slopes": ("change of slopes", ""),
    "cosine of gradients": ("cosine of gradients", ""),
    "cosine with another batch": ("cosine with another batch", ""),
    "time": ("time a scene", ""),
    "time a pair": ("time a pair", ""),
    "processor time": ("processor time a scene", ""),
    "processor time a pair": ("processor time a pair", ""),
}
SCANS = re.compile(r"scans \d+")  # groups that are kept in place of all scenes
COLLECTION = re.compile(r"collection \w+")  # groups that are kept beside them
SENSE = {"higher": 1.0, "lower": -1.0}
# What programs count, where it is not pairs.
COUNTED = {"reconstruction": "objects", "segmentation": "objects"}
NO_RIVALS = ("bfloat16", "building", "decoding", "survival")  # programs whose lines are not methods


def main(keep: Path | None = None, name: str = "", docs: Path = DOCS) -> None:
    """Makes the tables of all pages and the chart anew, or stores the figures of a run.

    Args:
        keep: folder of a run whose figures are stored; tables are not written then.
        name: what pages call it.
        docs: folder of the pages; figures lie in its folder figures.
    """
    if keep is not None:
        if not name:
            raise ValueError(f"{keep}: no name; needed --name, by which pages ask for its figures")
        kept = kept_of(json.loads((keep / "results.json").read_text(encoding="utf-8")))
        (docs / "figures").mkdir(exist_ok=True)
        text = json.dumps(kept, ensure_ascii=False, indent=1)
        (docs / "figures" / f"{name}.json").write_text(text + "\n", encoding="utf-8")
        return
    for page in sorted(docs.rglob("*.md")):
        text = page.read_text(encoding="utf-8")
        made = with_tables(text, docs / "figures")
        if made != text:
            page.write_text(made, encoding="utf-8")
    draw(docs)


def kept_of(results: dict[str, Any]) -> dict[str, Any]:
    """Of results.json, the figures that pages may show, over all scenes, by scans or collection, and their facts."""
    wanted = set(FIGURES.values())
    fields = ("name", "column", "method", "value", "unit", "better", "count", "failures", "ci95", "scenes")
    every = {r["group"] for r in results["rows"]}
    groups = set(filter(SCANS.fullmatch, every)) or {"all"}
    collections = set(filter(COLLECTION.fullmatch, every))
    groups |= collections if len(collections) > 1 else set()
    rows = [
        {k: r[k] for k in fields} | ({} if r["group"] == "all" else {"group": r["group"]})
        for r in results["rows"]
        if r["group"] in groups and (r["name"], r["column"]) in wanted
    ]
    facts = {k: results[k] for k in ("command", "date", "hardware", "versions")}
    return {**facts, "masks": results["settings"].get("masks", "true"), "rows": rows}


def with_tables(text: str, figures: Path) -> str:
    """A page with the tables that its marks ask for. Raises ValueError where one asks for what is not kept."""

    def made(match: re.Match[str]) -> str:
        return match.group(1) + table_of(match.group("what"), figures) + match.group(3)

    return BLOCK.sub(made, text)


def table_of(what: str, figures: Path) -> str:
    """The table of one mark, in Markdown."""
    asked = dict(part.strip().split(" = ", 1) for part in what.split(";"))
    names, shown = ([x.strip() for x in re.split(r",(?! paper's)", asked[key])] for key in ("runs", "show"))
    if unknown := [x for x in shown if x not in FIGURES]:
        raise ValueError(f"figures {unknown}; needed some of {list(FIGURES)}")
    runs = {}
    for name in names:
        path = figures / f"{name}.json"
        if not path.is_file():
            raise ValueError(
                f"{path}: no such figures; needed `python -m eval.docs_figures --keep RUN --name {name}`"
            )
        runs[name] = json.loads(path.read_text(encoding="utf-8"))
    if len(runs) > 1:
        lines = of_several(runs, shown)
    elif "by" in asked:
        lines = by_group(runs[names[0]], shown, asked["by"])
    elif "over" in asked:
        lines = over_groups(runs[names[0]], shown, asked["over"])
    elif asked.get("lines") == "methods":
        lines = of_methods(runs[names[0]], shown, asked.get("only", ""))
    else:
        lines = of_one(runs[names[0]], shown)
    return "\n".join(lines) + "\n"


def of_one(kept: dict[str, Any], shown: Sequence[str]) -> list[str]:
    """A line a figure, with its interval; a column a method."""
    methods = list(dict.fromkeys(r["method"] for r in kept["rows"]))
    lines = [row_of(["", *methods]), row_of(["---"] * (len(methods) + 1))]
    for figure in shown:
        rows = rows_of(kept, figure)
        best = max(map(worth, rows.values()), default=0.0)
        cells = [
            cell(r, len(methods) > 1 and worth(r) >= best) if (r := rows.get(m)) else "" for m in methods
        ]
        unit = next(iter(rows.values()))["unit"] if rows else ""
        lines.append(row_of([f"{figure} [{unit}]", *cells]))
    return [*lines, "", f"`{kept['command']}`, {kept['date'][:10]}, {rooms_of(kept)}."]


def of_methods(kept: dict[str, Any], shown: Sequence[str], only: str = "") -> list[str]:
    """A line a method, with intervals; a column a figure. `only`: methods whose names begin so."""
    tables = {figure: rows_of(kept, figure) for figure in shown}
    program = re.split(r"eval\.(\w+)", kept["command"])[1]
    rivals = program not in NO_RIVALS
    best = {f: max(map(worth, rows.values())) if rivals else math.inf for f, rows in tables.items()}
    units = {f: next(iter(rows.values()))["unit"] for f, rows in tables.items()}
    lines = [
        row_of(["", *(f"{f} [{unit}]" if unit else f for f, unit in units.items())]),
        row_of(["---"] * (len(shown) + 1)),
    ]
    for method in dict.fromkeys(r["method"] for r in kept["rows"] if r["method"].startswith(only)):
        found = [(rows.get(method), best[f]) for f, rows in tables.items()]
        cells = [cell(r, worth(r) >= most) if r else "" for r, most in found]
        lines.append(row_of([method, *cells]))
    facts = [f"`{kept['command']}`", kept["date"][:10]]
    if rivals:
        facts += [rooms_of(kept), f"{max(r['count'] for r in kept['rows'])} {COUNTED.get(program, 'pairs')}"]
    return [*lines, "", f"{', '.join(facts)}."]


def over_groups(kept: dict[str, Any], shown: Sequence[str], over: str) -> list[str]:
    """A line a method, a column a figure; in a cell its values in the groups `over 1`, `over 2`, and so on."""
    rows = {(r["method"], r["name"], r["column"], r.get("group")): r for r in kept["rows"]}
    groups = {g for *_, g in rows if g and g.startswith(f"{over} ")}
    groups = sorted(groups, key=lambda g: int(g.split()[1]))
    lines = []
    for method in dict.fromkeys(m for m, *_ in rows):
        found = [[rows.get((method, *FIGURES[f], g)) for g in groups] for f in shown]
        cells = (" / ".join(number(r["value"]) if r else "–" for r in of_figure) for of_figure in found)
        lines.append(row_of([method, *cells]))
    units = [next(r["unit"] for r in kept["rows"] if (r["name"], r["column"]) == FIGURES[f]) for f in shown]
    head = [f"after 1, 2, … {over}", *(f"{f} [{unit}]" for f, unit in zip(shown, units, strict=True))]
    facts = f"`{kept['command']}`, {kept['date'][:10]}, {rooms_of(kept)}, {kept['rows'][0]['count']} objects."
    return [row_of(head), row_of(["---"] * len(head)), *lines, "", facts]


def rooms_of(kept: dict[str, Any]) -> str:
    """How many rooms a run has, in words."""
    count = kept["rows"][0]["scenes"]
    return f"{count} room" + "s" * (count > 1)


def of_several(runs: dict[str, dict[str, Any]], shown: Sequence[str]) -> list[str]:
    """A line a run, a column a figure: ours / the best of the others."""
    dates = list(dict.fromkeys(kept["date"][:10] for kept in runs.values()))
    counted_in = "rooms, pairs" if "recall" in shown else "rooms, objects"
    head = ["run", *shown, counted_in, *["date"] * (len(dates) > 1)]
    lines = [row_of(head), row_of(["---"] * len(head))]
    for name, kept in runs.items():
        cells = [against_best(rows_of(kept, figure)) for figure in shown]
        counted = rows_of(kept, "recall") or rows_of(kept, shown[0])
        pairs = max((r["count"] for r in counted.values()), default=0)
        scenes = kept["rows"][0]["scenes"]
        date = [kept["date"][:10]] * (len(dates) > 1)
        lines.append(row_of([f"`{name}`", *cells, f"{scenes}, {pairs}", *date]))
    told = commands_of([general(name, kept["command"]) for name, kept in runs.items()])
    return [*lines, "", ", ".join([told, *dates] if len(dates) == 1 else [told]) + "."]


def commands_of(commands: Sequence[str]) -> str:
    """Commands that differ in options alone as one, with the options that only some have beside it."""
    parts = [re.split(r" (?=--)", c) for c in commands]
    programs, options = {p[0] for p in parts}, list(dict.fromkeys(o for p in parts for o in p[1:]))
    if len(programs) > 1:
        return ", ".join(f"`{c}`" for c in dict.fromkeys(commands))
    common = [o for o in options if all(o in p for p in parts)]
    some = [f"`{o}`" for o in options if o not in common]
    return f"`{' '.join([*programs, *common])}`" + (f", some with {', '.join(some)}" if some else "")


def general(name: str, command: str) -> str:
    """A command with what differs from run to run in capitals."""
    command = command.replace(f"--out runs/{name}", "--out runs/RUN")
    command = re.sub(r"(--masks|--scenes) \w+", lambda m: f"{m[1]} {m[1][2:].upper()}", command)
    return re.sub(r"--data rooms/\w+", "--data rooms/ROOMS", command)


def by_group(kept: dict[str, Any], shown: Sequence[str], by: str) -> list[str]:
    """A line a group of one run, such as `collection kenney`, a column a figure: ours / the best of the others."""
    groups = sorted({g for r in kept["rows"] if (g := r.get("group", "")).startswith(f"{by} ")})
    head = [by, *shown, "rooms, pairs"]
    lines = [row_of(head), row_of(["---"] * len(head))]
    for group in groups:
        figures = [rows_of(kept, figure, group) for figure in shown]
        first = next(iter(figures[0].values()))
        counted = f"{first['scenes']}, {first['count']}"
        lines.append(row_of([group.removeprefix(f"{by} "), *map(against_best, figures), counted]))
    return [*lines, "", f"`{kept['command']}`, {kept['date'][:10]}."]


def rows_of(kept: dict[str, Any], figure: str, group: str | None = None) -> dict[str, dict[str, Any]]:
    """By method, over all scenes or of a group."""
    key = FIGURES[figure]
    return {
        r["method"]: r for r in kept["rows"] if (r["name"], r["column"]) == key and r.get("group") == group
    }


def against_best(rows: dict[str, dict[str, Any]]) -> str:
    """Ours / the best of the others, the better one bold, or both."""
    others = [r for m, r in rows.items() if not m.startswith(OURS)]
    ours = [r for m, r in rows.items() if m.startswith(OURS)][:1]  # the run's own preset, not its variants
    chosen = [max(side, key=worth) for side in (ours, others) if side]
    best = max(map(worth, chosen), default=0.0)
    return " / ".join(bold(number(r["value"]), worth(r) >= best) for r in chosen)


def worth(row: dict[str, Any]) -> float:
    """More is better. None at all where too many fail for a median."""
    return -math.inf if row["value"] is None else SENSE[row["better"]] * row["value"]


def cell(row: dict[str, Any], best: bool) -> str:
    """A figure, its interval, and in how many cases there is none."""
    text = bold(number(row["value"]), best)
    # Times differ with what else a machine does, more than between rooms.
    if row["ci95"] and row["unit"] != "s":
        text += f" ({number(row['ci95'][0])} to {number(row['ci95'][1])})"
    return text + (f"; {row['failures']} failed" if row["failures"] else "")


def number(value: float | None) -> str:
    """Three digits, of whole numbers all; none where more than half fail."""
    if value is None:
        return "none"
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"


def bold(text: str, wanted: bool) -> str:
    """Bold in Markdown."""
    return f"**{text}**" if wanted else text


def row_of(cells: Sequence[str]) -> str:
    """A row of a table."""
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    run(main)
