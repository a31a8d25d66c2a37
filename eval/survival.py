"""What is on disk after SIGKILL at random moments of five commands, and what going on makes of it.

`python -m eval.survival --out runs/survival --moments 40 --seed 0`

`more2 run`, `add`, `batch` and `export`, and `train.prior`: on scenes of boxes, with the smallest prior, as files are
under test, not the method. A moment is right if every scene, export and weight file on disk opens, and the same command
(`--resume`) ends with the bytes of a run that nobody stopped and nothing beside them. Seconds, logs and pages, which
tell the time, and checkpoints are left out.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
import trimesh
import tyro

from eval.harness.results import cost, write_rows
from eval.scores.figures import Row
from more2_jax.config import load_config
from more2_jax.network.prior import Prior, init_prior, load_prior, save_prior
from more2_jax.storage.ply_files import write_points
from more2_jax.storage.scene_folder import load_scene, stored_at
from train.run.program import run
from train.run.settings import TrainingRun

Command = Literal["run", "add", "batch", "train", "export"]
ROOT = Path(__file__).parents[1]
TINY = ROOT / "configs" / "tiny.yaml"
SHAPES = ROOT / "train" / "shapes" / "open.npz"
EXPORTED = "room.glb"
STARTS_WITH_TWO = ("add", "export")  # scans in a living scene
# Few steps: the command line is under test, not the method.
FEW_STEPS = """
matching: {method: evidence, search: {points: 32, dense: 64, cells: 8, turns: 4, steps: 2, keep: 1}}
registration:
  method: surface
  points: 64
  steps: 2
  polish_steps: 2
  search: {points: 32, dense: 64, cells: 8, turns: 4, steps: 2, keep: 1}
pose_graph: {steps: 2}
joint: {points: 64, steps: 2}
meshing: {coarse: 8, resolution: 16}
"""
FEW_TRAINING_STEPS = """
model:
  encoder: {widths: [8, 8, 8], code: 8, neighbors: 4, head_channels: 8, points: 32,
            downsample_blocks: [2], downsample_factors: [2]}
  decoder: {hidden: 32, layers: 3, skip_layer: 2, dropout: 0.1}
training: {steps: 60, batch: 4, learning_rate: 1.0e-3, queries: 32, raw_points: 64, max_views: 2, warmup_steps: 2,
           validate_every: 10, picture_every: 1000}
"""
SIZES_M = np.array([[1.0, 0.5, 0.3], [0.4, 0.4, 1.2], [0.8, 0.9, 0.5]])  # of boxes


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How often, and where."""

    out: Path
    """Folder of survival.json and of the scenes, which are removed."""
    moments: int = 40
    """Processes that are killed."""
    seed: int = 0
    """Of commands and moments."""
    commands: tuple[Command, ...] = ("run", "add", "batch", "train", "export")
    """Which."""


@dataclass(frozen=True, kw_only=True)
class Place:
    """A folder with three scans of boxes, settings, weights, and a manifest."""

    folder: Path

    def prepare(self, prior: Prior | None = None) -> None:
        """Writes it; the weights are the smallest random ones, unless some are given."""
        self.folder.mkdir(parents=True, exist_ok=True)
        rng = np.random.default_rng(0)
        clouds = [rng.uniform(-0.5, 0.5, (100, 3)) * s for s in SIZES_M]
        for name, shift, count in (("a", 0.0, 2), ("b", 0.3, 2), ("c", 0.0, 3)):
            points = np.concatenate([clouds[k] + [2.0 * k + shift, 0, 0] for k in range(count)])
            write_points(
                self.folder / f"{name}.ply", points, np.repeat(np.arange(count) + 1, 100), "instance"
            )
        if prior is None:
            prior = init_prior(load_config(TINY, TrainingRun).model, jax.random.key(0), "tiny")
        save_prior(prior, self.folder / "tiny.npz")
        (self.folder / "few.yaml").write_text(FEW_STEPS, encoding="utf-8")
        (self.folder / "train.yaml").write_text(FEW_TRAINING_STEPS, encoding="utf-8")
        rows = [f"room_{k},a.ply;{b}.ply,few.yaml,tiny.npz" for k, b in enumerate("bc")]
        (self.folder / "scenes.csv").write_text("\n".join(["name,scans,config,prior", *rows]) + "\n")

    def words(self, command: Command, scenes: Path) -> list[str]:
        """The command line, after Python's name; it writes below `scenes`."""
        if command == "train":
            settings = ["--config", str(self.folder / "train.yaml"), "--shards", str(SHAPES)]
            return ["-m", "train.prior", *settings, "--out", str(scenes / "prior")]
        return ["-m", "more2_jax.cli.main", *self.more2(command, scenes)]

    def more2(self, command: Command, scenes: Path) -> list[str]:
        """The words of `more2`."""
        if command == "export":
            return ["export", str(scenes / "room"), "--format", "glb", "--out", str(scenes / EXPORTED)]
        scans = [str(self.folder / f"{n}.ply") for n in "abc"]
        more = ["--prior", str(self.folder / "tiny.npz")]
        if command == "run":
            options = ["--config", str(self.folder / "few.yaml"), "--resume"]
            return ["run", *scans, "--out", str(scenes / "room"), *more, *options]
        if command == "add":
            return ["add", str(scenes / "room"), scans[2], *more]
        return ["batch", str(self.folder / "scenes.csv"), "--out", str(scenes)]


def main(options: Annotated[Settings, tyro.conf.arg(name="")]) -> None:
    """Kills, looks, goes on, compares; prints a table and ends with exit code 1 if any moment was not right."""
    place = Place(folder=(options.out / "place").resolve())
    place.prepare()
    whole = {c: undisturbed(place, c) for c in dict.fromkeys(("run", *options.commands))}
    rng = np.random.default_rng(options.seed)
    told = list[dict[str, Any]]()
    for moment in range(options.moments):
        command = options.commands[moment % len(options.commands)]
        expected, seconds = whole[command]
        delay = float(rng.uniform(0, seconds))
        problem = one_moment(place, command, delay, expected)
        told.append({"command": command, "after_s": delay, "problem": problem})
        print(f"{moment + 1}: {command} killed after {delay:.2f} s: {problem or 'right'}", flush=True)
        write_rows(options.out, rows_of(told), program="survival", seed=options.seed, moments=told)
    shutil.rmtree(place.folder)
    bad = sum(bool(t["problem"]) for t in told)
    print(f"{len(told) - bad} of {len(told)} moments right; {options.out / 'results.json'}")
    if bad:
        sys.exit(1)


def rows_of(told: Sequence[Mapping[str, Any]]) -> list[Row]:
    """How many moments of each command there were, and how many of them were right."""
    rows = []
    for command in dict.fromkeys(t["command"] for t in told):
        problems = [t["problem"] for t in told if t["command"] == command]
        count = len(problems)
        asked = cost("moments", command, count, "", count=count, scenes=0)
        right = cost("right moments", command, problems.count(""), "", count=count, scenes=0)
        rows += [asked, replace(right, better="higher")]
    return rows


def undisturbed(place: Place, command: Command) -> tuple[dict[str, bytes], float]:
    """What the command leaves when nobody stops it, and how long it takes once its programs are compiled."""
    for _ in range(2):
        scenes = fresh(place, command, "whole")
        began = time.perf_counter()
        subprocess.run(process_words(place, command, scenes), check=True, stdout=subprocess.DEVNULL)
        seconds = time.perf_counter() - began
    if command == "run":  # others begin with its first two scans
        first_two = process_words(place, "run", place.folder / "two")
        words = [w for w in first_two if not w.endswith("c.ply")]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
    return content(scenes), seconds


def fresh(place: Place, command: Command, name: str) -> Path:
    """A folder as it is before the command."""
    scenes = place.folder / name
    shutil.rmtree(scenes, ignore_errors=True)
    if command in STARTS_WITH_TWO:
        shutil.copytree(place.folder / "two", scenes)
    else:
        scenes.mkdir()
    return scenes


def process_words(place: Place, command: Command, scenes: Path) -> list[str]:
    """How the command is started."""
    return [sys.executable, *place.words(command, scenes)]


def one_moment(place: Place, command: Command, delay_s: float, expected: dict[str, bytes]) -> str:
    """What is wrong after a kill that many seconds later, or after going on; nothing if all is right."""
    scenes = fresh(place, command, "killed")
    words = process_words(place, command, scenes)
    process = subprocess.Popen(
        words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True
    )
    time.sleep(delay_s)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()

    def again() -> str:
        done = subprocess.run(words, capture_output=True, text=True)
        return done.stderr.strip() if done.returncode else ""

    return wrong_after(command, scenes, expected, again)


def wrong_after(command: Command, scenes: Path, expected: dict[str, bytes], again: Callable[[], str]) -> str:
    """What is wrong on disk after a kill, or once `again` has gone on; nothing if all is right.

    `again` gives the same command, and returns what that was refused with.
    """
    try:
        found = [load_scene(folder)[0] for folder in scene_folders(scenes)]
        opens(scenes)
    except ValueError as error:
        return str(error)
    if command in STARTS_WITH_TWO and not found:
        return "the scene is lost"
    if command != "add" or len(found[0].scans) == 2:  # the third scan is not added twice
        if refused := again():
            return refused
    else:
        settle(scenes / "room")
    after = content(scenes)
    return ", ".join(sorted(k for k in after.keys() | expected.keys() if after.get(k) != expected.get(k)))


def opens(scenes: Path) -> None:
    """Reads exports and weights, but no hidden ones, which are half written. ValueError where one is cut short."""
    for path in scenes.glob("[!.]*.glb"):
        try:
            trimesh.load_scene(path)
        except (ValueError, IndexError) as error:  # NumPy's, of a file without a head
            raise ValueError(f"{path}: {error}") from error
    for path in scenes.glob("prior/[!.]*.npz"):
        load_prior(path)


def settle(folder: Path) -> None:
    """What a save leaves beside a folder when it is killed after its swap is cleared by the next."""
    for kind in ("new", "old", "lock"):
        beside = folder.with_name(f".{folder.name}.{kind}")
        shutil.rmtree(beside) if beside.is_dir() else beside.unlink(missing_ok=True)


def scene_folders(scenes: Path) -> list[Path]:
    """Every scene that is there, those cut short in a swap too."""
    names = {p.name.removeprefix(".").removesuffix(".old") for p in scenes.glob("*") if p.is_dir()}
    return [scenes / n for n in sorted(names) if (stored_at(scenes / n) / "scene.json").is_file()]


def content(scenes: Path) -> dict[str, bytes]:
    """Bytes of all files of all scenes and of a training, seconds and checkpoints left out."""
    found: dict[str, bytes] = {}
    for path in sorted(p for p in scenes.rglob("*") if p.is_file()):
        name = str(path.relative_to(scenes))
        if {"checkpoints", "tensorboard"} & set(path.relative_to(scenes).parts):
            continue
        if path.name in ("run.log", "report.html") or path.stem == "results":
            found[name] = b""
        elif path.name == "log.jsonl":
            lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
            found[name] = json.dumps([line | {"seconds": None} for line in lines]).encode()
        elif path.name == "scene.json":
            scene = json.loads(path.read_text(encoding="utf-8"))
            found[name] = json.dumps(scene | {"timing_s": None}).encode()
        else:
            found[name] = path.read_bytes()
    return found


if __name__ == "__main__":
    run(main)
