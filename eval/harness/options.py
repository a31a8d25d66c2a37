"""What every program of this folder is told."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import jax
import numpy as np

from eval.data.flyingshape import flyingshape
from eval.data.threerscan import threerscan
from eval.data.tilted import tilted
from eval.data.truth import Benchmark, KnownScene
from more2_jax.config import (
    DescentRegistration,
    FieldRegistration,
    PresetName,
    SceneConfig,
    preset,
)

Descending = DescentRegistration | FieldRegistration
Masks = Literal["true", "merged", "split", "eroded", "wrong", "predicted", "geometric", "changes"]
OURS = "ours"  # methods whose names begin so
SCENES_A_CHUNK = 4


def scenes_a_chunk() -> int:
    """By default: no local device is idle."""
    return max(SCENES_A_CHUNK, jax.local_device_count())


@dataclass(frozen=True, kw_only=True)
class Options:
    """Which data, which settings, and where results go."""

    data: Path
    """Folder of the data set."""
    out: Path
    """Folder of the results; a stopped run resumes there."""
    dataset: Literal["flyingshape", "3rscan"] = "flyingshape"
    """flyingshape: written by train.synthesize, or the published npz files."""
    preset: PresetName = "robust"
    """Settings of the method."""
    prior: str = "small"
    """Name of shipped weights, or a file."""
    scenes: int = 0
    """How many, from the first; 0 for all."""
    visits: int = 0
    """How many scans of each scene, from the first; 0 for all."""
    masks: Masks = "true"
    """true, damaged on purpose, or (3rscan) predicted: mask3d.labels.npz beside each scan; geometric and changes: none,
    rooms of regime real are cut as --segment does."""
    upright: Literal["auto", "yes", "no", "found"] = "auto"
    """Whether the method is told that objects only turn about the vertical; auto: as the data were made; found (of
    whole scenes): it is told nothing, as `more2 run`, and peers as the data were made."""
    rooms: Literal["all", "first", "none"] = "all"
    """Which scans keep what is no object: floor, walls, clutter."""
    tilt: float | None = None
    """Degrees by which every scan is tilted against gravity, each another way; as the data were made without it."""
    sensors: bool = True
    """Whether the method is told where the sensors of every scan stood, where the data say so. Peers never ask."""
    peers: bool = True
    """Also measure what one would use instead, on the same clouds."""
    chunk: int = field(default_factory=scenes_a_chunk)
    """Scenes that share a batch; by default 4, or one for each local device where there are more. Shards of one run
    must agree in it."""
    batch: int = 16
    """Clouds or pairs a compiled call takes; shared by all devices."""
    at_once: int = 1
    """Scenes that a device works on at the same time, where whole scenes are its unit: one for every core keeps a
    CPU busy. Times of a scene then include waiting for the others."""
    split: Literal["train", "validation", "test"] = "validation"
    """Of 3rscan."""
    fresh: bool = False
    """Forget an earlier run in `out` if its settings, weights or data are others."""
    shard: str = "1/1"
    """i/n: this process works on the i-th of n shares of the scenes, from 1, and need not know the others.
    eval.merge makes the tables of all shares."""
    workers: int = 0
    """Processes that stay alive over scenes; 0: this one alone. With --ray: actors, 0 for one a GPU, or one a core."""
    ray: str | None = None
    """Address of a Ray cluster whose actors do the work ("local" starts one here)."""
    scene_minutes: float | None = None
    """With --workers or --ray: a process that takes longer for a scene, or as many times longer for a chunk, is ended;
    the chunk is tried once more, then fails. None: any time."""


@dataclass(frozen=True, kw_only=True)
class OptionsBeside(Options):
    """Of programs whose tables may show several presets, on the same scenes."""

    beside: tuple[PresetName, ...] = ()
    """Other presets, each measured as further columns."""
    without_descent: bool = False
    """Also measure presets that register by descent without its steps: from their starts alone."""

    @property
    def presets(self) -> tuple[PresetName, ...]:
        """All, the run's own first, each once."""
        return tuple(dict.fromkeys((self.preset, *self.beside)))

    def methods(self, upright: bool | None) -> dict[str, SceneConfig]:
        """What is measured of ours, by name."""
        found = {f"{OURS}, {name}": preset(name, upright=upright) for name in self.presets}
        for name, config in list(found.items()) if self.without_descent else ():
            if isinstance(config.registration, Descending):
                starts = replace(config, registration=undescended(config.registration))
                found[f"{name}, without descent"] = starts
        return found


def undescended(method: Descending) -> Descending:
    """The method without the steps of its descent."""
    if isinstance(method, DescentRegistration):
        return replace(method, steps=0)
    return replace(method, search_steps=0, steps=0)


def benchmark(o: Options) -> Benchmark:
    """The data. Raises ValueError if there are none of that kind, or the masks are not to be had."""
    if not o.data.is_dir():
        raise ValueError(f"{o.data}: no such folder")
    if o.scenes < 0 or o.visits < 0 or o.visits == 1 or min(o.chunk, o.batch, o.at_once) < 1 or o.workers < 0:
        raise ValueError(
            f"scenes {o.scenes}, visits {o.visits}, chunk {o.chunk}, batch {o.batch}, at once {o.at_once},"
            f" workers {o.workers}; needed 0 (all) or more, two visits at least, positive chunk, batch and number at"
            " once"
        )
    if o.masks == "predicted" and o.dataset != "3rscan":
        raise ValueError(
            "predicted masks are read for 3rscan only; damaged ones are merged, split, eroded, wrong"
        )
    data = (
        threerscan(o.data, split=o.split, predicted=o.masks == "predicted")
        if o.dataset == "3rscan"
        else flyingshape(o.data)
    )
    if o.sensors and o.rooms == "all" and o.tilt is None:
        return data
    return replace(data, read=lambda name: less_told(data.read(name), o))


def less_told(scene: KnownScene, o: Options) -> KnownScene:
    """The scene without what the options withhold, and tilted if they say so."""
    scene = scene if o.tilt is None else tilted(scene, o.tilt)
    scene = scene if o.sensors else without_sensors(scene)
    kept = {"all": len(scene.scans), "first": 1, "none": 0}[o.rooms]
    bare = [replace(s, background=np.zeros((0, 3))) for s in scene.scans[kept:]]
    return replace(scene, scans=(*scene.scans[:kept], *bare))


def without_sensors(scene: KnownScene) -> KnownScene:
    """The scene as if nobody knew where its sensors stood."""
    return replace(scene, scans=tuple(replace(s, sensors=np.zeros((0, 3))) for s in scene.scans))


def is_upright(o: Options, data: Benchmark) -> bool:
    """Whether objects are taken to turn about the vertical only, where nobody looks for it."""
    return data.upright if o.upright in ("auto", "found") else o.upright == "yes"


def told_upright(o: Options, data: Benchmark) -> bool | None:
    """What the method is told; None: nothing."""
    return None if o.upright == "found" else is_upright(o, data)
