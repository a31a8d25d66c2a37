"""The folder of a run: settings that name it, a file for each finished scene, one for each shard that worked on it."""

from __future__ import annotations

import json
import os
import shutil
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from eval.scores.figures import Record


@dataclass(frozen=True, kw_only=True)
class RunFolder:
    """What a run's folder says by itself, without data or weights; `settings` name it: others need another folder."""

    out: Path
    names: tuple[str, ...]  # all scenes of the run, in order
    settings: dict[str, Any]
    right_deg: float  # a rotation error below it is a success

    def file(self, name: str) -> Path:
        """Where a scene's records are kept."""
        return self.out / "scenes" / f"{name}.json"

    def records(self) -> dict[str, list[Record]]:
        """Records of every finished scene, in the order of the names."""
        return {n: json.loads(self.file(n).read_text()) for n in self.names if self.file(n).exists()}

    def missing(self) -> list[str]:
        """Names of the scenes that are not finished."""
        return [n for n in self.names if not self.file(n).exists()]


def claim(out: Path, stated: dict[str, Any], *, fresh: bool) -> None:
    """Makes a folder that of a run. Raises ValueError if it is another's, unless `fresh`, which forgets that."""
    path = out / "settings.json"
    found = json.loads(path.read_text()) if path.exists() else stated
    if found != stated:
        other = differing(found, stated)
        if not fresh:
            raise ValueError(
                f"{out}: holds a run with other {', '.join(other)}; needed an empty folder, or --fresh"
            )
        for kept in ("scenes", "shards"):
            shutil.rmtree(out / kept, ignore_errors=True)
    (out / "scenes").mkdir(parents=True, exist_ok=True)
    write_json(path, stated)


def differing(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """Names of the settings in which two runs differ."""
    return sorted(k for k in one.keys() | other.keys() if one.get(k) != other.get(k))


def write_json(path: Path, content: Any) -> None:
    """Atomically, whichever processes and hosts write beside one another."""
    partial = path.with_suffix(f".partial-{socket.gethostname()}-{os.getpid()}")
    partial.write_text(json.dumps(_plain(content), indent=1), encoding="utf-8")
    partial.replace(path)


def _plain(value: Any) -> Any:
    """NumPy numbers as Python's, paths as text; what is not finite, as None: a failure."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value
