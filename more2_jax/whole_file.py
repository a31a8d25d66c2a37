"""Files that are written whole or not at all: what was there stays until the new one is complete."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """A hidden path beside `path` to write to, with the same suffix; it takes the place of `path` at the end.

    After an error it is gone, and `path` is as it was. A killed process leaves it; its name is always the same, so
    the next attempt replaces it. Two processes may not write one file at a time.
    """
    path = Path(path)
    partial = path.with_name(f".{path.stem}.partial{path.suffix}")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def check_writable(path: str | Path) -> None:
    """Raises ValueError unless something may be written at `path`; its folders need not be there yet."""
    parent = next(p for p in Path(path).resolve().parents if p.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise ValueError(f"{path}: cannot write in {parent}; needed a folder that can be written")
