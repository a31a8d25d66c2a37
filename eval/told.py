"""Whether what is told with a probability holds, over the rooms of several runs of `eval.end_to_end` together:

`python -m eval.told runs/real_mix606 runs/real_perfect606`

A single run has too few matches, and far too few changes, to tell. Needs neither the data nor the weights.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from eval.harness.options import OURS
from eval.scores.figures import Record, Row, rows_of
from eval.scores.told_chances import FIGURES
from train.run.program import run


def main(runs: Annotated[tuple[Path, ...], tyro.conf.Positional]) -> None:
    """Prints every figure of matches, changes and motions, with its interval over rooms, and of how many.

    Args:
        runs: folders of `eval.end_to_end`.
    """
    Console().print(table_of(rows_of(FIGURES, records_of_ours(runs))))


def records_of_ours(runs: tuple[Path, ...]) -> dict[str, list[Record]]:
    """Records of the method's own presets, by room. Raises ValueError where a folder holds none."""
    found = dict[str, list[Record]]()
    for folder in runs:
        files = sorted((folder / "scenes").glob("*.json"))
        if not files:
            raise ValueError(f"{folder}: no records of rooms; needed a folder that eval.end_to_end wrote")
        for file in files:
            own = [r for r in json.loads(file.read_text()) if str(r.get("method", "")).startswith(OURS)]
            found[f"{folder}/{file.stem}"] = own
    return found


def table_of(rows: list[Row]) -> Table:
    """A line a figure."""
    table = Table("method", "figure", "value", "95 %", "of", title="What is told with a probability")
    for row in rows:
        value = "-" if row.value is None else f"{row.value:.1f} {row.unit}"
        interval = "-" if row.ci95 is None else "{:.1f} to {:.1f}".format(*row.ci95)
        table.add_row(row.method, row.name, value, interval, str(row.count))
    return table


if __name__ == "__main__":
    run(main)
