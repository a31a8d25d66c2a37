"""The tables of a run that several processes shared: `--shard i/n` each, then

`python -m eval.merge runs/shard_1 runs/shard_2 --out runs/whole`

Needs neither the data nor the weights. Makes the results.json, the tables and the plots that one process makes of the
same records.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import tyro

from eval.harness.options import Options
from eval.harness.program import conclude, program_named
from eval.harness.run_folder import RunFolder, claim, differing
from eval.harness.shards import Part, read_parts
from more2_jax.scans.files.json_file import read_json
from train.run.program import run

SHOWN = 5  # names of scenes that are missing


@dataclass(frozen=True, kw_only=True)
class Share:
    """A folder and a shard that worked on it."""

    out: Path
    settings: dict[str, Any]
    part: Part


def main(runs: Annotated[tuple[Path, ...], tyro.conf.Positional], out: Path, fresh: bool = False) -> None:
    """Brings the scenes of shards together and makes their tables.

    Args:
        runs: folders that `--shard i/n` wrote; shards may share one.
        out: folder of the whole run.
        fresh: forget an earlier run in `out` if it is another's.
    """
    shares = [
        Share(out=folder, settings=read_json(folder / "settings.json"), part=part)
        for folder in runs
        for part in read_parts(folder)
    ]
    if not shares:
        raise ValueError("no folders; needed those that --shard wrote")
    check_same(shares)
    first = shares[0]
    whole = RunFolder(
        out=out, names=first.part.names, settings=first.settings, right_deg=first.part.right_deg
    )
    sources = scene_files(shares, whole)
    claim(out, whole.settings, fresh=fresh)
    for name, file in sources.items():
        if not (whole.file(name).exists() and file.samefile(whole.file(name))):
            copy(file, whole.file(name))
    program = program_named(whole.settings["program"])
    conclude(program, whole, whole_options(program.settings, first.part, out), together(shares))


def check_same(shares: Sequence[Share]) -> None:
    """Raises ValueError, naming what differs, unless all shares are of one run on the same libraries."""
    first = shares[0]
    for share in shares[1:]:
        other = differing(first.settings, share.settings)
        other += differing(first.part.same_work(), share.part.same_work())
        other += ["scenes"] if first.part.names != share.part.names else []
        other += differing(*({"versions": s.part.circumstances["versions"]} for s in (first, share)))
        if other:
            names = ", ".join(dict.fromkeys(other))
            raise ValueError(
                f"{share.out} (shard {share.part.shard}) has other {names} than {first.out}; needed one run"
            )


def scene_files(shares: Sequence[Share], whole: RunFolder) -> dict[str, Path]:
    """Where each scene's records are: in the first folder that has them. Raises ValueError if a scene is missing."""
    folders = [dataclasses.replace(whole, out=out) for out in dict.fromkeys(s.out for s in shares)]
    found = {n: f.file(n) for f in reversed(folders) for n in whole.names if f.file(n).exists()}
    if missing := [n for n in whole.names if n not in found]:
        names = ", ".join([*missing[:SHOWN], *(["…"] if len(missing) > SHOWN else [])])
        have = ", ".join(dict.fromkeys(s.part.shard for s in shares))
        raise ValueError(
            f"{len(missing)} of {len(whole.names)} scenes missing ({names}); there are shards {have}"
        )
    return {n: found[n] for n in whole.names}


def copy(source: Path, target: Path) -> None:
    """Atomically."""
    partial = target.with_suffix(".partial")
    shutil.copyfile(source, partial)
    partial.replace(target)


def whole_options(kind: type[Options], part: Part, out: Path) -> Options:
    """The options of one process that does all."""
    values: dict[str, Any] = part.options | {"out": out, "shard": "1/1", "workers": 0, "ray": None}
    paths = [k for k, hint in get_type_hints(kind).items() if hint in (Path, Path | None)]
    given: dict[str, Any] = {k: Path(values[k]) for k in paths if values[k] is not None}
    return kind(**values | given)


def together(shares: Sequence[Share]) -> dict[str, Any]:
    """Where and when: all hardware there was, the latest date."""
    told = [s.part.circumstances for s in shares]
    hardware = "; ".join(dict.fromkeys(c["hardware"] for c in told))
    return {**told[0], "date": max(c["date"] for c in told), "hardware": hardware}


if __name__ == "__main__":
    run(main)
