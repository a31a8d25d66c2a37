"""Scans without masks, cut without a network: `--segment changes` beside `--segment geometric`, class-agnostic.

`python -m eval.segmentation --data data/real_perfect --out runs/segmentation`

On rooms of regime `real` (`train.synthesize`), their masks removed. The truth is the object of every vertex.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import Bool, Float, Integer
from rich.console import Console

from eval.harness.results import write_rows
from eval.harness.tables import on_screen
from eval.scores.figures import Figure, Record, rows_of
from eval.scores.segment_scores import SEGMENT_FIGURES, overlaps, segment_records
from more2_jax.geometry.segmentation import segment_geometric
from more2_jax.geometry.segmentation_config import SegmentationConfig
from more2_jax.scans.files.json_file import read_json
from more2_jax.scans.files.npz import read_arrays
from more2_jax.scans.labeled_cloud import ReadOptions
from more2_jax.scans.read_scan import read_cloud
from more2_jax.scans.seen_empty import UnlabeledScan
from more2_jax.scans.temporal_segmentation import segment_changes
from train.run.program import run

LEAST_POINTS = 64  # of an object and of an instance: as `more2 run` has them
FIGURES = (
    *SEGMENT_FIGURES,
    Figure(name="time a scene", key="seconds", statistic="mean", unit="s", better="lower"),
)
TRUTH = ("owner", "object", "T_scan_model", "T_scan_room")
Found = tuple[Integer[np.ndarray, " n"], Float[np.ndarray, " k"]]  # instance of every point, score of each


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Which rooms, and where results go."""

    data: Path
    """Folder of rooms of regime `real`, two scans or more each."""
    out: Path
    """Folder of results.json."""
    scenes: int = 0
    """How many, from the first; 0 for all."""


@dataclass(frozen=True, kw_only=True)
class Visit:
    """One scan without its masks, and the truth: an object for every point (−1: none), and which of these moved."""

    scan: UnlabeledScan
    owner: Integer[np.ndarray, " n"]
    moved: Bool[np.ndarray, " o"]


def geometric(visits: Sequence[Visit]) -> list[Found]:
    """Each scan alone; its instances have no score."""
    found = [segment_geometric(v.scan.points, SegmentationConfig()).instance for v in visits]
    return [(instance, np.ones(instance.max(initial=0))) for instance in found]


def changes(visits: Sequence[Visit]) -> list[Found]:
    """All scans together; the score is the share of an instance that another scan shows empty."""
    return [(s.instance, s.emptied) for s in segment_changes([v.scan for v in visits])]


METHODS: dict[str, Callable[[Sequence[Visit]], list[Found]]] = {"geometric": geometric, "changes": changes}


def main(options: Annotated[Settings, tyro.conf.arg(name="")]) -> None:
    """AP at IoU 0.5 of all objects and of those that moved, by rooms in one frame and in frames of their own."""
    folders = [p.parent for p in sorted(options.data.glob("scene_*/scene.json"))]
    folders = [f for f in folders if f.suffix != ".partial"][: options.scenes or None]
    if not folders:
        raise ValueError(
            f"{options.data}: no scene_*/scene.json; needed rooms of train.synthesize --regime real"
        )
    records: dict[str, list[Record]] = {f.name: scored_scene(f) for f in folders}
    rows = rows_of(FIGURES, records, ("frames",))
    write_rows(options.out, rows, program="segmentation", masks="none", scenes=len(folders))
    Console().print(on_screen([r for r in rows if r.group == "all"], "Instances without a network"))


def scored_scene(folder: Path) -> list[Record]:
    """Records of both methods on one room, each with how the scans' frames lie."""
    frames, visits = read_visits(folder)
    records: list[Record] = []
    for method, find in METHODS.items():
        began = time.process_time()
        try:
            found = find(visits)
        except ValueError:  # refused: no instance
            found = [(np.zeros(len(v.owner), np.int64), np.zeros(0)) for v in visits]
        own: list[Record] = [{"seconds": time.process_time() - began}]
        for f, v in zip(found, visits, strict=True):
            own += segment_records(overlaps(*f, v.owner, v.moved, LEAST_POINTS))
        records += [{"method": method, "frames": frames, **r} for r in own]
    return records


def read_visits(folder: Path) -> tuple[str, list[Visit]]:
    """How the scans' frames lie (`aligned`, `own`), and the scans. Raises ValueError for another regime."""
    scene = read_json(folder / "scene.json")
    if "frames" not in scene:
        raise ValueError(
            f"{folder}: regime {scene.get('regime')!r}; needed real, where every vertex has an owner"
        )
    files = [folder / s["file"] for s in scene["scans"]]
    truths = [read_arrays(f.with_suffix(".truth.npz"), TRUTH)[0] for f in files]
    places = [
        {
            str(o): np.linalg.inv(t["T_scan_room"]) @ T
            for o, T in zip(t["object"], t["T_scan_model"], strict=True)
        }
        for t in truths
    ]
    visits = []
    for k, (file, truth) in enumerate(zip(files, truths, strict=True)):
        cloud = read_cloud(file, ReadOptions(masks_needed=False))
        moved = [
            not _stayed(str(o), places[k], [p for j, p in enumerate(places) if j != k])
            for o in truth["object"]
        ]
        visits.append(
            Visit(
                scan=UnlabeledScan(points=cloud.points, normals=cloud.normals),
                owner=truth["owner"].astype(np.int64),
                moved=np.array(moved, bool),
            )
        )
    return scene["frames"], visits


def _stayed(name: str, here: dict[str, np.ndarray], elsewhere: Sequence[dict[str, np.ndarray]]) -> bool:
    """Whether an object stands in every other scan of the room where it stands in this one."""
    return all(name in there and np.abs(there[name] - here[name]).max() < 1e-6 for there in elsewhere)


if __name__ == "__main__":
    run(main)
