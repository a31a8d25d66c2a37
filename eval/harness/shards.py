"""What a shard of a run (`--shard 2/8`: the second of eight) leaves for merging.

Shares are dealt in chunks, not in scenes: scenes of a chunk are encoded in one batch, and a batch of other scenes may
round otherwise. So shards, a run that was stopped, and one process all compute the same batches.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eval.harness.options import Options
from eval.harness.run_folder import RunFolder, write_json
from more2_jax.workers.shares import shard_of

# Options that change no result.
ELSEWHERE = ("data", "out", "shard", "workers", "ray", "scene_minutes", "fresh")


@dataclass(frozen=True, kw_only=True)
class Part:
    """What a shard left in a run's folder beside its scenes: what merging needs, so that it needs no data."""

    options: dict[str, Any]
    names: tuple[str, ...]  # all scenes of the run
    right_deg: float
    circumstances: dict[str, Any]  # hardware, versions, date
    shard: str

    def same_work(self) -> dict[str, Any]:
        """The options that must agree between shards of one run."""
        return {k: v for k, v in self.options.items() if k not in ELSEWHERE}


def write_part(run: RunFolder, o: Options, circumstances: dict[str, Any]) -> None:
    """Notes in the folder what shard worked on it, with which options, where."""
    shard = shard_of(o.shard)
    part = Part(
        options=dataclasses.asdict(o),
        names=run.names,
        right_deg=run.right_deg,
        circumstances=circumstances,
        shard=str(shard),
    )
    folder = run.out / "shards"
    folder.mkdir(exist_ok=True)
    write_json(folder / f"{shard.number:04d}_of_{shard.count:04d}.json", dataclasses.asdict(part))


def read_parts(out: Path) -> list[Part]:
    """All shards that worked on a folder. Raises ValueError where none did."""
    files = sorted((out / "shards").glob("*_of_*.json"))
    if not files or not (out / "settings.json").is_file():
        raise ValueError(f"{out}: no run of a program of eval; needed folders that --shard wrote")
    found = [json.loads(f.read_text()) for f in files]
    return [Part(**{**p, "names": tuple(p["names"])}) for p in found]
