"""Floors and walls with masks of their own: told by their shape, and by nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from furnished_room import BOXES, box, panel
from scipy.spatial.transform import Rotation

from more2_jax.scans.read_scan import read_scan
from more2_jax.scans.structural_shapes import FEWEST, drop_structure

X, Y, HEIGHT = 5.0, 4.0, 2.4
FLOOR, FIRST_WALL, RUG, PICTURE = 20, 21, 30, 31
WALLS = [
    ([0, 0, 0], [0, Y, HEIGHT]),
    ([X, 0, 0], [X, Y, HEIGHT]),
    ([0, 0, 0], [X, 0, HEIGHT]),
    ([0, Y, 0], [X, Y, HEIGHT]),
]


def annotated():
    """Every surface numbered: boxes from 1, the floor, four walls, a rug on the floor and a picture on a wall."""
    rng = np.random.default_rng(0)
    parts = {k: box(rng, *b) for k, b in enumerate(BOXES, 1)}
    parts[FLOOR] = panel(rng, [0, 0, 0], [X, Y, 0])
    parts |= {FIRST_WALL + k: panel(rng, *w) for k, w in enumerate(WALLS)}
    parts[RUG] = panel(rng, [1.0, 1.2, 0.01], [3.4, 2.2, 0.01])
    parts[PICTURE] = panel(rng, [0.02, 1.0, 1.2], [0.02, 2.2, 2.0])
    return np.concatenate(list(parts.values())), np.repeat(list(parts), [len(p) for p in parts.values()])


ROOM = {FLOOR, *range(FIRST_WALL, FIRST_WALL + 4)}


def dropped(points, instance, labels=None):
    left, said = drop_structure(points, instance, labels or {})
    gone = set(instance.tolist()) - set(left.tolist())
    assert [s.what for s in said] == [f"instance {i}" for i in sorted(gone)]
    assert ((left == instance) | ((left == 0) & np.isin(instance, list(gone)))).all()
    return gone


def test_floor_and_walls_go_and_all_else_stays():
    assert dropped(*annotated()) == ROOM


@pytest.mark.parametrize("seed", range(3))
def test_neither_direction_nor_order_nor_numbers_matter(seed):
    points, instance = annotated()
    rng = np.random.default_rng(seed)
    order, rotation = rng.permutation(len(points)), Rotation.random(random_state=seed).as_matrix()
    moved = (points @ rotation.T + rng.normal(0, 5, 3))[order]
    assert dropped(moved, 2**62 - instance[order]) == {2**62 - i for i in ROOM}


def test_one_mask_of_all_walls_is_walls():
    points, instance = annotated()
    walls = (instance >= FIRST_WALL) & (instance < FIRST_WALL + 4)
    assert dropped(points, np.where(walls, FIRST_WALL, instance)) == {FLOOR, FIRST_WALL}


def test_what_has_a_name_stays_and_a_number_of_a_class_is_none():
    points, instance = annotated()
    assert dropped(points, instance, {FLOOR: "stage", FIRST_WALL: "12", FIRST_WALL + 1: ""}) == ROOM - {FLOOR}


def test_a_rug_stays_where_the_floor_is_background():
    points, instance = annotated()
    large = np.random.default_rng(1).uniform([0.3, 0.3, 0.01], [3.6, 3.0, 0.01], (4000, 3))
    points, instance = np.concatenate([points, large]), np.append(instance, np.full(len(large), 40))
    assert dropped(points, np.where(np.isin(instance, list(ROOM)), 0, instance)) == set()


def test_of_objects_alone_none_is_the_room():
    points, instance = annotated()
    alone = instance < FLOOR
    assert dropped(points[alone], instance[alone]) == set()


@pytest.mark.parametrize("count", range(FEWEST))
def test_of_fewer_masks_none_is_the_room(count):
    points, instance = annotated()
    rows = np.isin(instance, [FLOOR, FIRST_WALL][:count])
    assert dropped(points[rows], instance[rows]) == set()


def test_degenerate_scans_lose_nothing():
    assert dropped(np.zeros((40, 3)), np.repeat(np.arange(1, 5), 10)) == set()
    points, instance = annotated()
    points[0] = 1e9  # one point strays farther than the grid of voxels reaches
    assert dropped(points, instance) == set()


def test_a_file_is_read_with_the_room_as_background(tmp_path):
    points, instance = annotated()
    np.savez(tmp_path / "room.npz", points=points, instance=instance)
    scan = read_scan(tmp_path / "room.npz")
    assert {i.id for i in scan.instances} == set(instance.tolist()) - ROOM
    assert len(scan.background) == np.isin(instance, list(ROOM)).sum()
    assert {s.what for s in scan.skipped} == {f"instance {i}" for i in ROOM}
    (said,) = scan.warnings
    assert all(f"instance {i}" in said for i in ROOM)


def test_names_of_points_tell_the_room_too(tmp_path):
    points, instance = annotated()
    label = np.where(instance == FLOOR, "floor", np.where(instance == PICTURE, "window", "thing"))
    np.savez(tmp_path / "room.npz", points=points, instance=instance, label=label)
    scan = read_scan(tmp_path / "room.npz")
    assert {i.id for i in scan.instances} == set(instance.tolist()) - {FLOOR, PICTURE}
    assert {s.what for s in scan.skipped} == {f"instance {FLOOR} (floor)", f"instance {PICTURE} (window)"}
    assert not scan.warnings
