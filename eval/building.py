"""A building: rooms of a benchmark side by side as one place, and what its stages take of time and memory.

`python -m eval.building --data data/flying_sparse --out runs/building --objects 16 74 150`

Every size is measured in a process of its own, as a process's peak memory only grows; Linux only, whose kernel can be
told to forget a peak. Rooms are repeated where there are too few, so that a building has identical copies.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from eval.data.flyingshape import flyingshape
from eval.harness.plots import pyplot, save
from eval.harness.results import cost, write_rows
from eval.performance.stopwatch import Seconds
from eval.scores.figures import Row
from more2_jax.config import PresetName, preset
from more2_jax.network.prior import load_prior
from more2_jax.progress import Progress
from more2_jax.scene import add_scan, reconstruct, start_scene
from more2_jax.storage.waiting_meshes import WaitingMeshes
from more2_jax.types import Instance, LivingScene, Scan
from train.rooms.scene_files import read_scene
from train.rooms.visits import FlyingScene
from train.run.program import run

PITCH_M = 10.0  # from one room's middle to the next one's: no wall of a room of 7 by 6 m meets another
FILL_NOISE_M = 0.002  # of points that are repeated
MEMORY = Path("/proc/self/status")
FORGET_PEAK = ("/proc/self/clear_refs", "5")  # proc(5): "VmHWM is reset to the current resident set size"

Pair = tuple[int, int]  # an object's instances in the first scan and in the second


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Which rooms, how many objects, and where results go."""

    data: Path
    """Folder of scenes, as `train.synthesize` writes them."""
    out: Path
    """Folder of the results."""
    preset: PresetName = "robust"
    """Settings of the method."""
    prior: str = "small"
    """Name of shipped weights, or a file."""
    memory_mb: int = 1024
    """What batches may take, as in the settings of a scene."""
    objects: tuple[int, ...] = (8, 16, 37, 74, 150)
    """Sizes of the buildings, in objects of the first scan."""
    points: int = 16_000
    """Points of every object: those of objects with fewer are repeated, with noise. 0: as they are."""
    meshes: bool = True
    """Also refine poses and extract meshes."""
    keep_masks: bool = False
    """Leave masks as they are."""
    one: int = 0
    """Measure this size alone, in this process, and print it."""


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What one size took, by stage in the order of the work: wall clock, processor time of all threads, and peaks
    of the resident set (MB)."""

    objects: int
    instances: int  # of the second scan
    points: int  # of both scans' objects
    seconds: dict[str, float]
    cpu_seconds: dict[str, float]
    peak_mb: dict[str, float]
    found: int  # pairs that were matched,
    right: int  # those of them that are one object, or copies of it in other rooms,
    right_place: int  # and those that are one object
    true: int  # pairs that could have been


def main(options: Annotated[Settings, tyro.conf.arg(name="")]) -> None:
    """Measures each size, draws time and memory over it, and writes results.json."""
    if options.one:
        print(json.dumps(asdict(measured(options, options.one))))
        return
    options.out.mkdir(parents=True, exist_ok=True)
    sizes = list[dict[str, Any]]()
    for count in options.objects:
        sizes.append(in_own_process(count))
        rows = [row for size in sizes for row in rows_of(size)]
        write_rows(options.out, rows, program="building", sizes=sizes)
        print(json.dumps(sizes[-1]))
        draw(options.out / "building", sizes)


def rows_of(size: dict[str, Any]) -> list[Row]:
    """One size as rows of results.json."""
    method, count = f"{size['objects']} objects", size["true"]
    share = 100 * size["right"] / max(count, 1)
    right = cost("right pairs", method, share, "%", count=count, scenes=1)
    return [
        cost("points", method, size["points"], "", count=count),
        cost("processor time", method, sum(size["cpu_seconds"].values()), "s", count=count),
        cost("peak memory", method, max(size["peak_mb"].values()), "MB", count=count),
        replace(right, better="higher"),
    ]


def in_own_process(count: int) -> dict[str, Any]:
    """`measured`, by this program called anew. Raises ValueError where that fails."""
    command = [sys.executable, "-m", "eval.building", *sys.argv[1:], "--one", str(count)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise ValueError(f"{count} objects: exit {done.returncode}; needed 0")
    return json.loads(done.stdout.strip().splitlines()[-1])


def measured(options: Settings, count: int) -> Measured:
    """One building, scan by scan, with peaks and seconds of its stages."""
    prior, upright = load_prior(options.prior), flyingshape(options.data).upright
    config = replace(preset(options.preset, upright=upright), memory_mb=options.memory_mb)
    if options.keep_masks:
        config = replace(config, repair_masks=False)
    folders = sorted(p.parent for p in options.data.glob("scene_*/scene.json"))
    (first, second), truth = building([read_scene(folder) for folder in folders], count, options.points)
    counts = [len(s.instances) for s in (first, second)]
    points = sum(len(i.points) for s in (first, second) for i in s.instances)
    watch = Watch()
    scene = start_scene(prior, first, config, progress=watch)
    del first  # as `more2 run` does once a scan is added
    watch.mark("rest")
    scene = add_scan(prior, scene, second, config, progress=watch)
    del second
    watch.mark("rest")
    if options.meshes:
        with WaitingMeshes(options.out / "meshes") as keep:  # as `more2 run` does with a large scene
            scene = reconstruct(prior, scene, config, progress=watch, keep=keep)
        watch.mark("rest")
    return Measured(
        objects=counts[0],
        instances=counts[1],
        points=points,
        seconds=watch.seconds,
        cpu_seconds=watch.cpu_seconds,
        peak_mb=watch.peak_mb,
        **matches(scene, truth),
    )


def matches(scene: LivingScene, truth: Sequence[tuple[Pair, str]]) -> dict[str, int]:
    """How many pairs were found, and how many of them are true."""
    found = {
        (o.observations[0].instance, o.observations[1].instance)
        for o in scene.objects
        if [s.scan for s in o.observations] == [0, 1]
    }
    first, second = ({pair[side]: thing for pair, thing in truth} for side in (0, 1))
    return {
        "found": len(found),
        "right": sum(a in first and first[a] == second.get(b) for a, b in found),
        "right_place": len(found & {pair for pair, _ in truth}),
        "true": len(truth),
    }


class Watch:
    """A watcher of stages that notes the seconds and the peak memory of each; what lies between is `rest`."""

    def __init__(self) -> None:
        self._since = Seconds(time.perf_counter(), time.process_time())
        self.seconds: dict[str, float] = {}
        self.cpu_seconds: dict[str, float] = {}
        self.peak_mb: dict[str, float] = {}
        self.mark("before")

    def __call__(self, event: Progress) -> None:
        if event.event != "advanced":
            self.mark("rest" if event.event == "started" else event.stage)

    def mark(self, stage: str) -> None:
        """What was done since the last mark was `stage`."""
        now, peak = Seconds(time.perf_counter(), time.process_time()), peak_mb()
        wall, cpu = now.wall - self._since.wall, now.cpu - self._since.cpu
        print(f"{stage}: {wall:.1f} s, processor {cpu:.1f} s, {peak:.0f} MB", file=sys.stderr, flush=True)
        self.peak_mb[stage] = max(self.peak_mb.get(stage, 0.0), peak)
        if stage != "before":
            self.seconds[stage] = self.seconds.get(stage, 0.0) + wall
            self.cpu_seconds[stage] = self.cpu_seconds.get(stage, 0.0) + cpu
        self._since = now
        Path(FORGET_PEAK[0]).write_text(FORGET_PEAK[1])


def peak_mb() -> float:
    """Most memory this process has had resident since its peak was last forgotten, MB."""
    line = next(x for x in MEMORY.read_text().splitlines() if x.startswith("VmHWM"))
    return int(line.split()[1]) * 1024 / 1e6


# --- rooms side by side -------------------------------------------------------------------------------------


def building(
    rooms: Sequence[FlyingScene], count: int, points: int = 0
) -> tuple[tuple[Scan, Scan], list[tuple[Pair, str]]]:
    """The first two scans of rooms in a grid, until the first holds `count` objects; and its true pairs.

    Each pair with a name for the thing that it is, which is the same for its copies in repeated rooms. `points` as in
    `Settings`. Raises ValueError where the rooms hold no object.
    """
    if not any(room.scans[0].instances for room in rooms):
        raise ValueError(f"building got {len(rooms)} rooms without objects; needed one with some")
    sides: tuple[list[Scan], list[Scan]] = ([], [])
    truth, left, number = list[tuple[Pair, str]](), count, 0
    ids = [1, 1]  # the next instance of each scan
    while left > 0:
        room, place = rooms[number % len(rooms)], spiral(number) * PITCH_M
        scans = [moved(scan, place) for scan in room.scans[:2]]
        scans[0] = replace(scans[0], instances=scans[0].instances[:left])
        new = [{i.id: ids[k] + n for n, i in enumerate(s.instances)} for k, s in enumerate(scans)]
        for o in room.objects:
            pair = tuple(new[k].get(o.instance.get(k, -1), 0) for k in (0, 1))
            if all(pair):
                truth.append(((pair[0], pair[1]), f"{room.name}/{o.name}"))
        for k, scan in enumerate(scans):
            rng = np.random.default_rng((number, k))
            own = tuple(replace(filled(i, points, rng), id=new[k][i.id]) for i in scan.instances)
            sides[k].append(replace(scan, instances=own))
            ids[k] += len(own)
        left, number = left - len(scans[0].instances), number + 1
    return (joined("first", sides[0]), joined("second", sides[1])), truth


def spiral(n: int) -> np.ndarray:
    """Places (x, y, 0) of a square grid, ring by ring: the first n² of them are a square for every odd n."""
    ring = int(np.ceil((np.sqrt(n + 1) - 1) / 2))
    if ring == 0:
        return np.zeros(3)
    side, step = divmod(n - (2 * ring - 1) ** 2, 2 * ring)
    x, y = ring, step - ring + 1
    for _ in range(side):
        x, y = -y, x
    return np.array([x, y, 0.0])


def moved(scan: Scan, shift: np.ndarray) -> Scan:
    """The scan at another place."""
    instances = tuple(replace(i, points=i.points + shift) for i in scan.instances)
    return replace(
        scan, instances=instances, background=scan.background + shift, sensors=scan.sensors + shift
    )


def filled(i: Instance, points: int, rng: np.random.Generator) -> Instance:
    """The instance with at least so many points: its own, then some of them again with noise."""
    more = rng.integers(0, len(i.points), max(0, points - len(i.points)))
    noise = rng.normal(0, FILL_NOISE_M, (len(more), 3))
    return replace(
        i,
        points=np.concatenate([i.points, i.points[more] + noise]),
        colors=None if i.colors is None else np.concatenate([i.colors, i.colors[more]]),
        normals=None if i.normals is None else np.concatenate([i.normals, i.normals[more]]),
    )


def joined(name: str, parts: Sequence[Scan]) -> Scan:
    """Scans of several rooms as one."""
    return Scan(
        name=name,
        source=name,
        instances=tuple(i for part in parts for i in part.instances),
        background=np.concatenate([part.background for part in parts]),
        sensors=np.concatenate([part.sensors for part in parts]),
    )


# --- what is written ----------------------------------------------------------------------------------------


def draw(path: Path, rows: Sequence[dict[str, Any]]) -> list[Path]:
    """Processor time and peak memory over the number of objects, by stage, both axes logarithmic."""
    figure, panels = pyplot().subplots(1, 2, figsize=(8.5, 3.6))
    count = np.array([r["objects"] for r in rows], float)
    for axes, key, label in zip(
        panels, ("cpu_seconds", "peak_mb"), ("processor seconds", "peak memory (MB)"), strict=True
    ):
        for stage in (s for s in rows[-1][key] if s != "before"):
            axes.plot(count, [r[key].get(stage, np.nan) for r in rows], marker="o", label=stage)
        total = np.array(
            [sum(r[key].values()) if key == "cpu_seconds" else max(r[key].values()) for r in rows]
        )
        axes.plot(count, total, color="black", marker="o", label="all")
        growth = count * np.log(count)
        axes.plot(count, total[0] * growth / growth[0], color="gray", linestyle=":", label="n log n")
        axes.set(xscale="log", yscale="log", xlabel="objects of a scan", ylabel=label)
        axes.grid(alpha=0.3, which="both")
    panels[0].legend(fontsize=7)
    figure.tight_layout()
    return save(figure, path)


if __name__ == "__main__":
    run(main)
