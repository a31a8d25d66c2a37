"""What a run leaves behind: results.json, tables.md, tables.tex, and plots."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.console import Console

from eval.harness.options import Options
from eval.harness.run_folder import RunFolder, write_json
from eval.harness.runs import hardware
from eval.harness.tables import latex, markdown, on_screen
from eval.scores.figures import Figure, Record, Row, rows_of


def finish(
    run: RunFolder,
    o: Options,
    figures: Sequence[Figure],
    records: Mapping[str, Sequence[Record]],
    groups: Sequence[str] = (),
    circumstances: Mapping[str, Any] | None = None,
) -> list[Row]:
    """Writes and prints all figures of a run. `circumstances`: where it ran, if not here and now. Returns the rows."""
    rows = rows_of(figures, records, groups)
    told = provenance(run, o, circumstances_now() if circumstances is None else circumstances)
    write_json(run.out / "results.json", {**told, "rows": [dataclasses.asdict(r) for r in rows]})
    facts = run.settings["data"]
    title = f"{run.settings['program']}, {facts['dataset']}, {facts.get('regime')}"
    (run.out / "tables.md").write_text(markdown(rows, title), encoding="utf-8")
    (run.out / "tables.tex").write_text(latex(rows, title), encoding="utf-8")
    console = Console()
    console.print(on_screen([r for r in rows if r.group == "all"], title))
    console.print(f"{len(records)} of {len(run.names)} scenes; tables in {run.out}", highlight=False)
    return rows


def write_rows(out: Path, rows: Sequence[Row], **stated: Any) -> None:
    """results.json of a program without a `RunFolder`: command, date, hardware, versions, settings as stated, rows."""
    out.mkdir(parents=True, exist_ok=True)
    told = {**circumstances_now(), "settings": stated, "rows": [dataclasses.asdict(r) for r in rows]}
    write_json(out / "results.json", told)


def cost(
    name: str, method: str, value: float, unit: str, column: str = "", count: int = 1, scenes: int = 1
) -> Row:
    """A row of what something takes: time or memory, the less the better, without an interval."""
    return Row(
        name=name,
        method=method,
        value=value,
        unit=unit,
        column=column,
        count=count,
        scenes=scenes,
        better="lower",
        failures=0,
        ci95=None,
        group="all",
    )


def provenance(run: RunFolder, o: Options, circumstances: Mapping[str, Any]) -> dict[str, Any]:
    """Command, data, settings, hardware, versions: what a figure belongs to."""
    return {
        **circumstances,
        "command": portable(words_of(o, run.settings["program"])),
        "scenes_asked": len(run.names),
        "settings": run.settings,
    }


def circumstances_now() -> dict[str, Any]:
    """Command as given, date, hardware, versions."""
    main = Path(sys.argv[0])
    name = f"{main.parent.name}.{main.stem}"
    return {
        "command": portable(["python", "-m", name, *sys.argv[1:]]),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "hardware": hardware(),
        "versions": {p: _version(p) for p in ("jax", "open3d-cpu", "small-gicp", "kiss-matcher")},
    }


def words_of(o: Options, program: str) -> list[str]:
    """The command line of a run: what differs from the defaults, however the run was started."""
    words = ["python", "-m", f"eval.{program}"]
    for f in dataclasses.fields(o):
        value, flag = getattr(o, f.name), f.name.replace("_", "-")
        default = f.default if f.default_factory is dataclasses.MISSING else f.default_factory()
        if value == default or f.name == "fresh":
            continue
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            words += [f"--{flag}", *map(str, value if isinstance(value, tuple) else (value,))]
    return words


def portable(words: Sequence[str]) -> str:
    """A command with the last part alone of every absolute path: others keep their files elsewhere."""
    return " ".join(Path(w).name if w.startswith("/") else w for w in words)


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
