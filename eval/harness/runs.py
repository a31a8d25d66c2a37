"""A run over many scenes: resumable by scene, each with a file of its own."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import os
import platform
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

from eval.data.cut_scans import CUTS, with_cuts
from eval.data.flyingshape import digest
from eval.data.masks import DAMAGES, with_masks
from eval.data.truth import Benchmark, KnownScene
from eval.harness.extra import library
from eval.harness.options import Options, benchmark, told_upright
from eval.harness.run_folder import RunFolder, claim, write_json
from eval.scores.figures import Record
from more2_jax.config import SceneConfig, preset
from more2_jax.network.prior import Prior, load_prior
from more2_jax.workers.shares import shard_of

VERSION = 1
PEER_LIBRARIES = ("open3d", "small_gicp")  # that peers of all programs are made of
WHOLE_SCENES = "end_to_end"  # the program that looks for the vertical, if asked
Work = Callable[[Sequence[KnownScene]], Sequence[list[Record]]]  # records of every scene of a chunk


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run(RunFolder):
    """What all scenes of a run share."""

    data: Benchmark
    prior: Prior
    config: SceneConfig


def start_run(program: str, o: Options, settings: dict[str, Any]) -> Run:
    """Opens or resumes the run in `o.out`.

    Raises ValueError if that folder holds a run of other settings, weights or data, unless `o.fresh`, and where
    `open_run` does.
    """
    run = open_run(program, o, settings)
    claim(run.out, run.settings, fresh=o.fresh)
    return run


def open_run(program: str, o: Options, settings: dict[str, Any]) -> Run:
    """Data, weights and settings of a run; its folder is not touched.

    Raises ValueError if there are no such data or weights, if peers are asked for whose libraries cannot be imported,
    and if the vertical is to be found where no whole scenes are made.
    """
    if o.upright == "found" and program != WHOLE_SCENES:
        raise ValueError(f"{program}: upright found; needed auto, yes or no, as it makes no whole scenes")
    if o.peers:  # a peer that cannot run would count as one that fails on every scene
        for name in PEER_LIBRARIES:
            library(name)
    data, prior = benchmark(o), load_prior(o.prior)
    config = preset(o.preset, upright=told_upright(o, data))
    stated = {
        "version": VERSION,
        "program": program,
        "data": {**data.facts, "digest": digest(o.data)},
        "prior": o.prior,
        "weights": weights_digest(prior),
        "preset": o.preset,
        "config": dataclasses.asdict(config),
        "masks": o.masks,
        "rooms": o.rooms,
        "visits": o.visits,
        **({} if o.tilt is None else {"tilt": o.tilt}),
        **settings,
    }
    return Run(
        out=o.out,
        data=data,
        names=data.names[: o.scenes or None],
        settings=json.loads(json.dumps(stated)),
        right_deg=data.right_deg,
        prior=prior,
        config=config,
    )


def weights_digest(prior: Prior) -> str:
    """Names weights by their values and settings: other draws make other codes of the same weights."""
    content = hashlib.sha256(json.dumps(dataclasses.asdict(prior.config)).encode())
    for leaf in jax.tree.leaves(prior.params):
        content.update(np.ascontiguousarray(leaf).tobytes())
    return content.hexdigest()[:12]


def run_scenes(run: Run, o: Options, work: Work) -> dict[str, list[Record]]:
    """Works on the scenes of this shard that are not finished, `o.chunk` at a time; returns the records of all."""
    todo = unfinished_chunks(run, o)
    with progress_bar() as bar:
        task = bar.add_task(run.settings["program"], total=sum(map(len, todo)))
        for names, scenes in read_ahead(run, o, todo):
            keep(run, names, work(scenes))
            bar.advance(task, len(names))
    return run.records()


def unfinished_chunks(run: RunFolder, o: Options) -> list[Sequence[str]]:
    """Chunks of this shard with an unfinished scene: whole, for batches of other scenes may round otherwise."""
    parts = shard_of(o.shard).of(list(chunks(run.names, o.chunk)))
    return [names for names in parts if not all(run.file(n).exists() for n in names)]


def keep(run: RunFolder, names: Sequence[str], found: Sequence[list[Record]]) -> None:
    """Writes the records of a chunk's scenes; files that are there already stay."""
    for name, records in zip(names, found, strict=True):
        if not run.file(name).exists():
            write_json(run.file(name), records)


def read_ahead(
    run: Run, o: Options, parts: Sequence[Sequence[str]]
) -> Iterator[tuple[Sequence[str], list[KnownScene]]]:
    """The scenes of every chunk and their names; the next chunk is read while this one is worked on."""
    with ThreadPoolExecutor(1) as reader:
        coming = [reader.submit(read_chunk, run, o, names) for names in parts[:1]]
        for names, following in itertools.zip_longest(parts, parts[1:]):
            scenes = coming.pop().result()
            if following:
                coming.append(reader.submit(read_chunk, run, o, following))
            yield names, scenes


def read_chunk(run: Run, o: Options, names: Sequence[str]) -> list[KnownScene]:
    """Some scenes, with as many scans and through the masks asked for."""
    return [masked(run.data.read(n).first_scans(o.visits), o.masks) for n in names]


def masked(scene: KnownScene, masks: str) -> KnownScene:
    """The scene through the masks asked for."""
    if masks in CUTS:
        return with_cuts(scene, masks)
    return with_masks(scene, DAMAGES[masks]) if masks in DAMAGES else scene


def chunks(names: Sequence[str], size: int) -> Iterator[Sequence[str]]:
    """Consecutive parts of at most `size`."""
    return (names[k : k + size] for k in range(0, len(names), size))


def progress_bar() -> Progress:
    """Scenes done and the time that is left; silent where nobody looks."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    return Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), disable=not sys.stderr.isatty())


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
