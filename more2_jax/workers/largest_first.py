"""The order of tasks in which none that is large is left to run alone at the end: by the size of their files."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")


def largest_first(tasks: Iterable[T], files: Callable[[T], Iterable[Path]]) -> list[T]:
    """The tasks by bytes of the files and folders they read, the most first; equal ones in the order they had."""
    return sorted(tasks, key=lambda task: sum(map(bytes_of, files(task))), reverse=True)


def bytes_of(path: Path) -> int:
    """Of a file, or of all files below a folder; 0 where nothing is."""
    if path.is_dir():
        return sum(p.stat().st_size for p in path.rglob("*") if p.is_file())
    return path.stat().st_size if path.is_file() else 0
