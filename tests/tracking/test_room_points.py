"""Points of a mask that are floor or wall go on in the background; a table's top does not, and stays."""

import numpy as np
import pytest
from factories import embedding
from furnished import box, chair, corner, sheet
from scipy.spatial.transform import Rotation

from more2_jax.geometry.poses import apply_pose
from more2_jax.tracking.objects import new_object
from more2_jax.tracking.room_points import BACKGROUND_POINTS, POINTS_A_CELL, remembered, without_room
from more2_jax.types import Instance, Repair

CHAIR, ROOM = chair(), corner()
PATCH = (np.abs(ROOM[:, :2] - [1.7, 1.45]) < 0.15).all(axis=1)  # of floor, beside and between two legs
WALL = (ROOM[:, 1] < 0.01) & (np.abs(ROOM[:, 0] - 1.4) < 0.2) & (np.abs(ROOM[:, 2] - 0.6) < 0.2)
FEWEST = 64


def mask(points, id_=5, **more):
    return Instance(id=id_, points=points, **more)


def elsewhere():
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.4, -1.0, 0.7]).as_matrix()
    T[:3, 3] = [120.0, -40.0, 7.0]
    return T


def rows_left(points, background, T=None):
    T = np.eye(4) if T is None else T
    (left,) = without_room([mask(apply_pose(T, points))], apply_pose(T, background), FEWEST).instances
    kept = set(map(bytes, left.points))
    return np.array([bytes(p) in kept for p in apply_pose(T, points)])


def floors(rooms, points, seed=0):
    """The floors of rooms side by side, 6 by 6 m each."""
    some = np.random.default_rng(seed).uniform(0, 6, (rooms * points, 3)) * [1, 1, 0] + [0, 0, 0.5]
    return some + np.repeat(np.arange(rooms), points)[:, None] * [10.0, 0, 0]


@pytest.mark.parametrize("points", [0, 1, BACKGROUND_POINTS])
def test_a_small_background_is_remembered_as_it_is(points):
    np.testing.assert_array_equal(remembered(floors(1, points)), floors(1, points))


def test_of_a_building_so_many_points_a_room_are_remembered_however_many_rooms_there_are():
    """A floor of 36 cells; 100 of them are a building, of which no room has fewer points than it may have."""
    one = remembered(floors(1, 70_000))
    assert BACKGROUND_POINTS / 2 < len(one) <= BACKGROUND_POINTS
    building = remembered(floors(100, 7_000))
    room = (building[:, 0] // 10).astype(int)
    counts = np.bincount(room, minlength=100)
    most = POINTS_A_CELL * 36
    assert most / 2 < counts.min() and counts.max() < 1.1 * most and counts.sum() <= 100 * most


def test_a_clean_mask_loses_nothing():
    cleared = without_room([mask(CHAIR)], ROOM, FEWEST)
    assert cleared.instances[0].points is CHAIR and not cleared.dropped


@pytest.mark.parametrize("patch", [PATCH, WALL], ids=["floor", "wall"])
def test_a_patch_of_floor_or_wall_goes_and_nothing_else(patch):
    assert patch.sum() > 100
    left = rows_left(np.concatenate([CHAIR, ROOM[patch]]), ROOM[~patch])
    assert left[len(CHAIR) :].mean() < 0.03
    assert left[: len(CHAIR)].mean() > 0.99


def test_no_direction_is_taken_for_up():
    points = np.concatenate([CHAIR, ROOM[PATCH]])
    np.testing.assert_array_equal(
        rows_left(points, ROOM[~PATCH], elsewhere()), rows_left(points, ROOM[~PATCH])
    )


def test_what_was_cut_off_a_table_is_no_floor():
    """Most of a table's top is in the background: the floor is beneath it."""
    table = box([0.9, 0.9, 0.7], [2.3, 1.9, 0.74], np.random.default_rng(3))
    cut = table[:, 0] > 1.3
    assert rows_left(table[~cut], np.concatenate([ROOM, table[cut]])).all()


def test_the_front_of_a_cabinet_whose_edges_were_cut_off_is_no_wall():
    """Nothing is behind a front that one scan saw, and its edges lie in the background; it ends with the cabinet."""
    rng = np.random.default_rng(7)
    front = np.stack([rng.uniform(0, 1.2, 4000), np.zeros(4000), rng.uniform(0, 1.8, 4000)], axis=1)
    inner = (np.abs(front - [0.6, 0, 0.9]) < [0.45, 1, 0.7]).all(axis=1)
    side = np.stack([np.zeros(4000), rng.uniform(-0.6, 0, 4000), rng.uniform(0, 1.8, 4000)], axis=1)
    assert rows_left(np.concatenate([front[inner], side]), front[~inner]).all()


def test_a_picture_on_the_wall_stays():
    rng = np.random.default_rng(4)
    picture = sheet([1.0, 0.01, 1.0], [0.6, 0, 0], [0, 0, 0.5], rng)
    wall = ~((np.abs(ROOM[:, 0] - 1.3) < 0.3) & (np.abs(ROOM[:, 2] - 1.25) < 0.25) & (ROOM[:, 1] < 0.02))
    assert rows_left(picture, ROOM[wall]).all()


def test_without_a_background_all_stays():
    assert rows_left(np.concatenate([CHAIR, ROOM[PATCH]]), np.zeros((0, 3))).all()


def test_what_belongs_to_points_goes_with_them_and_it_is_told():
    points = np.concatenate([CHAIR, ROOM[PATCH]])
    colors = np.arange(len(points) * 3).reshape(-1, 3).astype(np.uint8)
    whole = mask(points, colors=colors, normals=points * 2)
    cleared = without_room([mask(CHAIR + [0, 0, 50.0], 4), whole], ROOM[~PATCH], FEWEST)
    left = cleared.instances[1]
    assert len(left.points) == len(left.colors) < len(points)
    np.testing.assert_array_equal(left.normals, left.points * 2)
    code = embedding(np.random.default_rng(0), np.zeros(3))
    objects = [new_object(k, 1, i, code) for k, i in enumerate(cleared.instances)]
    (repair,) = cleared.repairs(1, objects)
    assert (repair.object, repair.instances, repair.points) == ("object_001", (5,), len(points))
    assert repair.dropped == len(points) - len(left.points) and repair.share > 0.9
    assert not cleared.repairs(0, objects)  # of another scan
    part = Repair(object="object_000", instances=(4, 5))
    assert [r.object for r in cleared.repairs(1, objects[:1], [part])] == ["object_000"]
