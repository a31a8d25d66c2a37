"""A run over many scenes: resumable by scene, each with a file of its own; hosts share the scenes."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import os
import platform
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from eval.data.flyingshape import digest
from eval.data.masks import DAMAGES, with_masks
from eval.data.truth import Benchmark, KnownScene
from eval.harness.extra import library
from eval.harness.options import Options, benchmark, is_upright
from eval.scores.figures import Record
from more2_jax.config import SceneConfig, preset
from more2_jax.network.prior import Prior, load_prior

VERSION = 1
PEER_LIBRARIES = ("open3d", "small_gicp")  # that peers of all programs are made of
Work = Callable[[Sequence[KnownScene]], Sequence[list[Record]]]  # records of every scene of a chunk


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """What all scenes of a run share; `settings` name it: other settings need another folder."""

    out: Path
    data: Benchmark
    names: tuple[str, ...]
    settings: dict[str, Any]
    prior: Prior
    config: SceneConfig

    def file(self, name: str) -> Path:
        """Where a scene's records are kept."""
        return self.out / "scenes" / f"{name}.json"

    def records(self) -> dict[str, list[Record]]:
        """Records of every finished scene."""
        return {n: json.loads(self.file(n).read_text()) for n in self.names if self.file(n).exists()}


def start_run(program: str, o: Options, settings: dict[str, Any]) -> Run:
    """Opens or resumes the run in `o.out`.

    Raises ValueError if that folder holds a run of other settings, weights or data, unless `o.fresh`, and if peers are
    asked for whose libraries cannot be imported.
    """
    if o.peers:  # a peer that cannot run would count as one that fails on every scene
        for name in PEER_LIBRARIES:
            library(name)
    if o.distributed:
        jax.distributed.initialize()
    data, prior = benchmark(o), load_prior(o.prior)
    config = preset(o.preset, upright=is_upright(o, data))
    stated = {
        "version": VERSION,
        "program": program,
        "data": {**data.facts, "digest": digest(o.data)},
        "prior": o.prior,
        "weights": weights_digest(prior),
        "preset": o.preset,
        "config": dataclasses.asdict(config),
        "masks": o.masks,
        "visits": o.visits,
        **settings,
    }
    claim(o.out, json.loads(json.dumps(stated)), fresh=o.fresh)
    names = data.names[: o.scenes or None]
    return Run(out=o.out, data=data, names=names, settings=stated, prior=prior, config=config)


def claim(out: Path, stated: dict[str, Any], *, fresh: bool) -> None:
    """Makes a folder that of a run. Raises ValueError if it is another's, unless `fresh`, which forgets that."""
    path = out / "settings.json"
    found = json.loads(path.read_text()) if path.exists() else stated
    if found != stated:
        other = sorted(k for k in stated.keys() | found.keys() if stated.get(k) != found.get(k))
        if not fresh:
            raise ValueError(
                f"{out}: holds a run with other {', '.join(other)}; needed an empty folder, or --fresh"
            )
        if jax.process_index() == 0:
            shutil.rmtree(out / "scenes", ignore_errors=True)
    (out / "scenes").mkdir(parents=True, exist_ok=True)
    write_json(path, stated)


def weights_digest(prior: Prior) -> str:
    """Names weights by their values."""
    content = hashlib.sha256()
    for leaf in jax.tree.leaves(prior.params):
        content.update(np.ascontiguousarray(leaf).tobytes())
    return content.hexdigest()[:12]


def run_scenes(run: Run, o: Options, work: Work) -> dict[str, list[Record]]:
    """Works on the scenes that are not finished, `o.chunk` at a time; returns the records of all.

    With several hosts each takes every so many-th scene, and all wait for one another at the end.
    """
    mine = [n for i, n in enumerate(run.names) if i % jax.process_count() == jax.process_index()]
    todo = [n for n in mine if not run.file(n).exists()]
    with progress_bar() as bar:
        task = bar.add_task(run.settings["program"], total=len(mine), completed=len(mine) - len(todo))
        for names, scenes in read_ahead(run, o, todo):
            for name, records in zip(names, work(scenes), strict=True):
                write_json(run.file(name), records)
                bar.advance(task)
    if jax.process_count() > 1:
        from jax.experimental import multihost_utils

        multihost_utils.sync_global_devices(run.settings["program"])
    return run.records()


def read_ahead(run: Run, o: Options, todo: Sequence[str]) -> Iterator[tuple[Sequence[str], list[KnownScene]]]:
    """The scenes of a chunk and their names; the next chunk is read while this one is worked on."""

    def read(names: Sequence[str]) -> list[KnownScene]:
        return [masked(run.data.read(n).first_scans(o.visits), o.masks) for n in names]

    parts = list(chunks(todo, o.chunk))
    with ThreadPoolExecutor(1) as reader:
        coming = [reader.submit(read, names) for names in parts[:1]]
        for names, following in itertools.zip_longest(parts, parts[1:]):
            scenes = coming.pop().result()
            if following:
                coming.append(reader.submit(read, following))
            yield names, scenes


def masked(scene: KnownScene, masks: str) -> KnownScene:
    """The scene through the masks asked for."""
    return with_masks(scene, DAMAGES[masks]) if masks in DAMAGES else scene


def chunks(names: Sequence[str], size: int) -> Iterator[Sequence[str]]:
    """Consecutive parts of at most `size`."""
    return (names[k : k + size] for k in range(0, len(names), size))


def progress_bar() -> Progress:
    """Scenes done and the time that is left; silent where nobody looks."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    return Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), disable=not sys.stderr.isatty())


def write_json(path: Path, content: Any) -> None:
    """Atomically."""
    partial = path.with_suffix(f".partial{jax.process_index()}")
    partial.write_text(json.dumps(_plain(content), indent=1), encoding="utf-8")
    partial.replace(path)


def _plain(value: Any) -> Any:
    """NumPy numbers as Python's; what is not finite, as None: a failure."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value


def hardware() -> str:
    """What this ran on."""
    devices = jax.devices()
    model = next(
        (
            line.split(":", 1)[1].strip()
            for line in _lines(Path("/proc/cpuinfo"))
            if line.startswith("model name")
        ),
        platform.processor() or platform.machine(),
    )
    return f"{len(devices)} × {devices[0].device_kind}; {os.cpu_count()} cores, {model}"


def _lines(path: Path) -> list[str]:
    return path.read_text(errors="replace").splitlines() if path.is_file() else []
