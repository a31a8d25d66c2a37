"""Rooms without masks: scans are cut anew, and every object knows which instance shows it."""

from pathlib import Path

import numpy as np
import pytest
from dataset_writers.ply_file import vertex_columns, write_ply

from eval.data.cut_scans import CUTS, Cut, with_cuts
from eval.data.masks import LOST
from eval.data.truth import KnownObject, KnownScene
from more2_jax.types import Instance, Scan
from train.furniture.symmetry import SymmetryGroup

SCANS = 2


def box(center, side: float, rng: np.random.Generator) -> np.ndarray:
    p = rng.uniform(-0.5, 0.5, (6000, 3))
    p[np.arange(6000), rng.integers(0, 3, 6000)] = rng.choice([-0.5, 0.5], 6000)
    return p * side + center


def room(folder: Path) -> KnownScene:
    """Two scans of a floor, a wall, two boxes far apart, one of which moves, and one within the floor's thickness."""
    scans, true = [], []
    for k in range(SCANS):
        rng = np.random.default_rng(k)
        floor = rng.uniform([0, 0, 0], [4, 4, 0], (30_000, 3))
        wall = rng.uniform([0, 0, 0], [0, 4, 2], (20_000, 3))
        flat = rng.uniform([0.5, 3, 0.01], [0.9, 3.4, 0.02], (800, 3))
        own = [box([1, 1 + 0.8 * k, 0.36], 0.7, rng), box([2.8, 2.8, 0.31], 0.6, rng), flat]
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


def test_rooms_without_owners_of_vertices_are_refused(tmp_path: Path):
    scene = room(tmp_path)
    with pytest.raises(ValueError, match="regime real"):
        with_cuts(KnownScene(name=scene.name, scans=scene.scans, objects=scene.objects), "geometric")
