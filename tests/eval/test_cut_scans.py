"""Rooms without masks: scans are cut anew, and every object knows which instance shows it."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from dataset_writers.ply_file import vertex_columns, write_ply

from eval.data.cut_scans import CUTS, Cut, with_cuts
from eval.data.masks import LOST
from eval.data.truth import KnownObject, KnownScene
from eval.scores.tracks import Track, without_loose
from more2_jax.types import Instance, Scan
from train.furniture.symmetry import SymmetryGroup

SCANS = 2


def box(center, side: float, rng: np.random.Generator) -> np.ndarray:
    p = rng.uniform(-0.5, 0.5, (6000, 3))
    p[np.arange(6000), rng.integers(0, 3, 6000)] = rng.choice([-0.5, 0.5], 6000)
    return p * side + center


def room(folder: Path, loose: bool = False) -> KnownScene:
    """Two scans of a floor, a wall, two boxes far apart, one of which moves, and one within the floor's thickness.

    `loose`: and a box without an owner, elsewhere in each, and one that is on the wall in both.
    """
    scans, true = [], []
    for k in range(SCANS):
        rng = np.random.default_rng(k)
        floor = rng.uniform([0, 0, 0], [4, 4, 0], (30_000, 3))
        wall = rng.uniform([0, 0, 0], [0, 4, 2], (20_000, 3))
        flat = rng.uniform([0.5, 3, 0.01], [0.9, 3.4, 0.02], (800, 3))
        own = [box([1, 1 + 0.8 * k, 0.36], 0.7, rng), box([2.8, 2.8, 0.31], 0.6, rng), flat]
        if loose:
            floor = np.concatenate([floor, box([3.2 - k, 0.8, 0.21], 0.4, rng)])
            wall = np.concatenate([wall, box([0.05, 2.8, 1.2], 0.5, rng) * [0.2, 1, 1]])
        points = np.concatenate([floor, wall, *own]).astype(np.float32).astype(np.float64)
        masks = np.repeat([0, 0, 7, 8, 9], [len(floor), len(wall), *map(len, own)]).astype(np.int32)
        path = write_ply(folder / f"scan_{k}.ply", vertex_columns(points, instance=masks))
        shown = [Instance(id=i, points=points[masks == i]) for i in (7, 8, 9)]
        scans.append(Scan(name=path.stem, source=str(path), instances=tuple(shown)))
        true.append({f"object_{n}": points[masks == 7 + n] for n in range(3)})
    objects = tuple(
        KnownObject(
            name=f"object_{n}",
            category="box",
            copies=f"box_{n}",
            instance=dict.fromkeys(range(SCANS), 7 + n),
            T_scan_model=dict.fromkeys(range(SCANS), np.eye(4)),
            symmetry=SymmetryGroup.trivial(),
        )
        for n in range(3)
    )
    return KnownScene(name="room", scans=tuple(scans), objects=objects, true_points=tuple(true))


@pytest.mark.parametrize("cut", CUTS)
def test_every_object_takes_the_instance_that_shows_it(tmp_path: Path, cut: Cut):
    scene = room(tmp_path)
    found = with_cuts(scene, cut)
    for k in range(SCANS):
        for o in found.objects[:2]:
            own, true = found.instance(k, o.instance[k]).points, scene.true_points[k][o.name]
            shared = len({bytes(p) for p in own} & {bytes(p) for p in true})
            assert shared / (len(own) + len(true) - shared) > 0.75
        assert found.objects[2].instance[k] == LOST
        assert len(found.scans[k].instances) == 2
        points = sum(len(i.points) for i in found.scans[k].instances) + len(found.scans[k].background)
        assert points == 30_000 + 20_000 + 2 * 6000 + 800


@pytest.mark.parametrize("cut", CUTS)
def test_what_is_loose_counts_neither_way_and_what_is_on_a_wall_counts(tmp_path: Path, cut: Cut):
    T = np.eye(4)
    T[:2, 3] = 2.0
    scene = dataclasses.replace(room(tmp_path, loose=True), T_scan_room=(T, T), room_m=(4.0, 4.0))
    found = with_cuts(scene, cut)
    box_of = [[i.id for i in s.instances if 0.1 < i.points[:, 2].mean() < 0.3] for s in found.scans]
    assert [set(ids) for ids in found.loose] == [set(ids) for ids in box_of] and all(map(len, box_of))
    tracks = [
        Track(instance={k: i.id}, T_track_scan={k: np.eye(4)}, points=i.points)
        for k in range(SCANS)
        for i in found.scans[k].instances
    ]
    both = Track(
        instance={0: box_of[0][0], 1: found.objects[0].instance[1]},
        T_track_scan=dict.fromkeys(range(SCANS), np.eye(4)),
        points=tracks[0].points,
    )
    left = without_loose(found, [*tracks, both])
    assert len(left) == len(tracks) + 1 - sum(map(len, box_of)) and left[-1] is both
    assert without_loose(scene, tracks) == tracks


def test_rooms_without_owners_of_vertices_are_refused(tmp_path: Path):
    scene = room(tmp_path)
    with pytest.raises(ValueError, match="regime real"):
        with_cuts(KnownScene(name=scene.name, scans=scene.scans, objects=scene.objects), "geometric")
