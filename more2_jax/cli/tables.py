"""Tables as files: Parquet where pyarrow is installed, else CSV."""

from __future__ import annotations

import csv
import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from more2_jax.whole_file import whole_file


def needs_parquet(path: Path) -> tuple[Any, Any]:
    """pyarrow and its part for Parquet. Raises ValueError where it is not installed."""
    try:
        return importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    except ImportError as error:
        raise ValueError(
            f"{path}: Parquet needs pyarrow: pip install 'more2-jax[tables]'; CSV needs nothing"
        ) from error


def write_table(stem: Path, columns: dict[str, type], rows: Sequence[dict[str, Any]]) -> Path:
    """Writes `stem`.parquet, or .csv without pyarrow; atomically. Returns its path. What a row lacks is empty."""
    rows = [{c: row.get(c) for c in columns} for row in rows]
    try:
        arrow, parquet = needs_parquet(stem)
    except ValueError:
        return _write_csv(stem.with_suffix(".csv"), list(columns), rows)
    path = stem.with_suffix(".parquet")
    kinds = {str: arrow.string(), int: arrow.int64(), float: arrow.float64()}
    schema = arrow.schema([(name, kinds[kind]) for name, kind in columns.items()])
    with whole_file(path) as partial:
        parquet.write_table(arrow.Table.from_pylist(rows, schema=schema), partial)
    return path


def _write_csv(path: Path, columns: Sequence[str], rows: Sequence[dict[str, Any]]) -> Path:
    with whole_file(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)
    return path
