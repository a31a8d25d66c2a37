"""Scans of regime `real` as `--segment` cuts them, for those without masks; and which object each instance shows."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal

import numpy as np

from eval.data.masks import LOST, best_masks
from eval.data.truth import KnownObject, KnownScene
from more2_jax.geometry.poses import Points, Pose, apply_pose
from more2_jax.geometry.segmentation import segment_geometric
from more2_jax.geometry.segmentation_config import SegmentationConfig
from more2_jax.scans.labeled_cloud import LabeledCloud, ReadOptions
from more2_jax.scans.read_scan import read_cloud, scan_of
from more2_jax.scans.seen_empty import UnlabeledScan
from more2_jax.scans.temporal_segmentation import segment_changes
from more2_jax.types import Instance, Scan

Cut = Literal["geometric", "changes"]
CUTS: tuple[Cut, ...] = ("geometric", "changes")
LEAST_POINTS = 64  # of an instance, as `more2 run` has it
MOSTLY = 0.5  # share of an instance's points that makes it a part of an object, or loose
# Rooms of regime `real` have nothing on their walls and floors that reaches so far into them, drift included.
WALL_M, FLOOR_M = 0.12, 0.04


def with_cuts(scene: KnownScene, cut: Cut) -> KnownScene:
    """The scene without its masks: every scan read from its file and cut anew.

    Raises ValueError for a scene whose files have no owner of every vertex beside them.
    """
    if not scene.true_points:
        raise ValueError(
            f"{scene.name}: masks {cut!r} need rooms of train.synthesize --regime real, where every vertex has an owner"
        )
    clouds = [read_cloud(Path(s.source), ReadOptions(masks_needed=False)) for s in scene.scans]
    scans = tuple(
        scan_of(Path(s.source), dataclasses.replace(c, instance=i), "m", LEAST_POINTS)
        for s, c, i in zip(scene.scans, clouds, instances_of(clouds, cut), strict=True)
    )
    own = [shown_by(scene.true_points[k], scan) for k, scan in enumerate(scans)]
    objects = tuple(_with_instances(o, own) for o in scene.objects)
    loose = tuple(
        loose_instances(scan, scene.true_points[k], T, scene.room_m)
        for k, (scan, T) in enumerate(zip(scans, scene.T_scan_room, strict=False))
    )
    return dataclasses.replace(scene, scans=scans, objects=objects, loose=loose)


def loose_instances(
    scan: Scan, true: dict[str, Points], T_scan_room: Pose, room_m: tuple[float, float]
) -> frozenset[int]:
    """Ids of instances that mostly show what is no known object and stands free in the room.

    Such things are others at every visit (`train.rooms.surroundings`): to tell them as added or removed is right.
    """
    owned = {bytes(p) for points in true.values() for p in np.ascontiguousarray(points, np.float64)}
    most = np.array([*room_m, np.inf]) / 2 - WALL_M

    def is_loose(points: Points) -> bool:
        free = np.array([bytes(p) not in owned for p in np.ascontiguousarray(points, np.float64)])
        places = apply_pose(np.linalg.inv(T_scan_room), points)
        inside = (np.abs(places) < most).all(axis=1) & (places[:, 2] > FLOOR_M)
        return bool((free & inside).mean() > MOSTLY)

    return frozenset(i.id for i in scan.instances if is_loose(i.points))


def instances_of(clouds: list[LabeledCloud], cut: Cut) -> list[np.ndarray]:
    """The instance of every point of every scan."""
    if cut == "changes":
        scans = [UnlabeledScan(points=c.points, normals=c.normals) for c in clouds]
        return [s.instance for s in segment_changes(scans)]
    return [segment_geometric(c.points, SegmentationConfig()).instance for c in clouds]


Shown = dict[str, tuple[int, tuple[int, ...]]]


def shown_by(true: dict[str, np.ndarray], scan: Scan) -> Shown:
    """Of every object by its name: the instance that shows it, `LOST` without one, and all that are mostly its own."""
    names = list(true)
    owned = [Instance(id=k, points=true[name]) for k, name in enumerate(names)]
    best = best_masks(Scan(name="", source="", instances=tuple(owned)), scan)
    rows = [{bytes(p) for p in np.ascontiguousarray(o.points, np.float64)} for o in owned]
    parts: dict[int, list[int]] = {k: [] for k in range(len(names))}
    for i in scan.instances:
        points = [bytes(p) for p in np.ascontiguousarray(i.points, np.float64)]
        for k, own in enumerate(rows):
            if sum(p in own for p in points) > MOSTLY * len(points):
                parts[k].append(i.id)
    return {
        name: (best.get(k, LOST), tuple(dict.fromkeys([*([best[k]] if k in best else []), *parts[k]])))
        for k, name in enumerate(names)
    }


def _with_instances(o: KnownObject, own: list[Shown]) -> KnownObject:
    lost = (LOST, ())
    shown = {k: own[k].get(o.name, lost) for k in o.instance}
    return dataclasses.replace(
        o,
        instance={k: main for k, (main, _) in shown.items()},
        parts={k: parts for k, (main, parts) in shown.items() if len(parts) > 1},
        shared={},
    )
