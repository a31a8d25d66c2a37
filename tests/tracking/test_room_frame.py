"""The frame of a scan by the rooms: objects say which turn it is; nothing is said where nothing tells."""

import dataclasses

import numpy as np
import pytest
from factories import living_scene, scene_object, turn_z
from furnished_room import BOXES, box, empty_room

from more2_jax.geometry.poses import apply_pose
from more2_jax.geometry.room_alignment import RoomFit
from more2_jax.tracking.pose_voting import Votes
from more2_jax.tracking.room_frame import ALONE, OFF_M, borne_out, frame_by_rooms, most_likely
from more2_jax.tracking.rooms import Rooms, rooms_of
from more2_jax.types import Frame, Instance, Scan

SIDES_M = (5.0, 3.6)
AWAY = turn_z(np.deg2rad(67.0), np.zeros(3), np.array([5.0, -3.0, 0.4]))  # T_scan_scene
HALF_TURN = turn_z(np.pi, np.array([SIDES_M[0] / 2, SIDES_M[1] / 2, 0.0]), np.zeros(3))
LIFTED = np.eye(4)
LIFTED[2, 3] = -0.4  # what the heights of AWAY ask for
EMPTY = np.zeros((0, 3))


def objects(seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [box(rng, *b) for b in BOXES]


def votes(T_scene_scan: list[np.ndarray], centers: np.ndarray) -> Votes:
    """Each pair with one way."""
    rows = np.arange(len(centers))
    return Votes(T_scene_scan=np.stack(T_scene_scan)[:, None], center=centers, object=rows, instance=rows)


def told(stayed: int, motion="upright", backgrounds=None, away=AWAY, given=None):
    """The frame of a scan in which `stayed` of three boxes say that they stayed, the others that they moved."""
    before, after = objects(0), [apply_pose(away, o) for o in objects(1)]
    rooms = backgrounds or (empty_room(SIDES_M, 0), apply_pose(away, empty_room(SIDES_M, 1)))
    moved = turn_z(1.0, np.zeros(3), np.array([0.7, 0.5, 0.0]))
    ways = [np.linalg.inv(away) @ (np.eye(4) if k < stayed else moved) for k in range(3)]
    if given is None:
        given = LIFTED if motion == "upright" else np.eye(4)
    centers = np.stack([o.mean(axis=0) for o in after])
    known = Rooms(
        scene=rooms[0],
        scan=rooms[1],
        objects=[
            dataclasses.replace(scene_object(k, {0: np.eye(4)}), points=o, point_scan=np.zeros(len(o), int))
            for k, o in enumerate(before)
        ],
        instances=[Instance(id=k, points=o) for k, o in enumerate(after)],
    )
    return frame_by_rooms(known, votes(ways, centers), motion, given)


@pytest.mark.parametrize("motion", ["upright", "free"])
def test_one_object_that_stayed_tells_which_way_the_room_lies(motion):
    frame = told(1, motion)
    assert frame is not None
    np.testing.assert_allclose(frame.T_scene_scan @ AWAY, np.eye(4), atol=0.02)
    if motion == "upright":
        assert frame.T_scene_scan[2, 3] == LIFTED[2, 3]
        np.testing.assert_array_equal(frame.T_scene_scan[2, :3], [0, 0, 1])
    assert frame.sigma_m == OFF_M


def test_no_frame_is_told_where_no_object_stayed_or_rooms_are_not_seen_or_lie_as_given():
    lost = told(0)
    assert lost is not None and lost.unknown and lost.T_scene_scan is LIFTED
    assert told(3, backgrounds=(EMPTY, EMPTY)) is None
    assert told(3, backgrounds=(empty_room(SIDES_M, 0), EMPTY)) is None
    assert told(3, away=np.eye(4)) is None
    strays = np.concatenate([empty_room(SIDES_M, 0), [[500.0, 0, 0]]])
    assert told(3, backgrounds=(strays, empty_room(SIDES_M, 1))) is None


@pytest.mark.parametrize("motion", ["upright", "free"])
@pytest.mark.parametrize("stayed", [0, 3])
def test_a_scan_that_lies_nearly_as_given_is_put_where_the_rooms_fit(motion, stayed):
    away = turn_z(np.deg2rad(2.0), np.zeros(3), np.array([0.12, -0.05, 0.0]))
    frame = told(stayed, motion, away=away, given=np.eye(4))
    assert frame is not None and not frame.unknown
    np.testing.assert_allclose(frame.T_scene_scan @ away, np.eye(4), atol=0.02)
    assert frame.sigma_m == OFF_M


def test_a_frame_as_given_is_kept_where_it_is_off_by_no_more_than_rooms_are_or_more_objects_agree_with_it():
    assert told(3, away=turn_z(0.0, np.zeros(3), np.array([0.01, -0.01, 0.0])), given=np.eye(4)) is None
    room, shifted = empty_room(SIDES_M, 0), empty_room(SIDES_M, 1) + [0.15, -0.1, 0.0]
    assert told(3, backgrounds=(room, shifted), away=np.eye(4), given=np.eye(4)) is None
    assert told(0, backgrounds=(room, shifted), away=np.eye(4), given=np.eye(4)) is not None


def fit(T, closeness) -> RoomFit:
    return RoomFit(T_a_b=T, share=0.6, closeness=closeness)


@pytest.mark.parametrize(
    ("here", "there", "closeness", "expected"),
    [
        (2, 0, (0.8, 1.0), "here"),  # two that agree outweigh how closely rooms fit,
        (1, 0, (0.8, 1.0), None),  # one does not,
        (1, 0, (1.0, 0.8), "here"),
        (1, 0, (1.0, 0.99), None),  # and is not enough where rooms do not tell
        (2, 2, (1.0, 0.8), "here"),
        (2, 2, (1.0, 0.99), None),
        (1, 2, (1.0, 0.8), "there"),
        (0, 0, (1.0, 0.5), None),
    ],
)
def test_the_turn_that_objects_agree_with_is_taken(here, there, closeness, expected):
    rng = np.random.default_rng(0)
    centers = rng.uniform(0, 1, (here + there, 3)) * [2.0, 1.5, 0.5]
    ways = [np.eye(4)] * here + [HALF_TURN] * there
    said = (
        votes(ways, centers)
        if ways
        else Votes(
            T_scene_scan=np.zeros((0, 1, 4, 4)),
            center=EMPTY,
            object=np.zeros(0, int),
            instance=np.zeros(0, int),
        )
    )
    fits = [fit(np.eye(4), closeness[0]), fit(HALF_TURN, closeness[1])]
    for order in (fits, fits[::-1]):
        T = most_likely(order, said)
        found = None if T is None else "here" if np.array_equal(T, np.eye(4)) else "there"
        assert found == expected


def test_a_scan_that_lies_nobody_knows_how_is_no_room_to_compare_with():
    scene, points = living_scene(), np.eye(3)
    lies = (Frame(), Frame(T_scene_scan=AWAY), Frame(unknown=True))
    scans = [
        dataclasses.replace(s, background=k * points, frame=f)
        for k, (s, f) in enumerate(zip(scene.scans, lies, strict=True), 1)
    ]
    scene = dataclasses.replace(scene, scans=tuple(scans))
    found = rooms_of(scene, Scan(name="new", source="new", instances=(), background=7 * points))
    np.testing.assert_allclose(found.scene, apply_pose(AWAY, 2 * points))
    np.testing.assert_array_equal(found.scan, 7 * points)


@pytest.mark.parametrize(
    ("T", "count", "expected"),
    [
        (np.eye(4), 3, True),  # where the rooms fit
        (turn_z(0.02, np.zeros(3), np.array([0.05, 0, 0])), 3, True),
        (turn_z(1.0, np.zeros(3), np.zeros(3)), 3, False),  # three by chance
        (turn_z(1.0, np.zeros(3), np.zeros(3)), ALONE, True),
    ],
)
def test_a_vote_at_which_rooms_do_not_fit_needs_more_objects(T, count, expected):
    centers = np.random.default_rng(0).uniform(0, 2, (count, 3))
    rooms = Rooms(scan=empty_room(SIDES_M, 1))
    vars(rooms)["fits"] = [fit(np.eye(4), 1.0), fit(HALF_TURN, 0.9)]  # as if worked out
    assert borne_out(T, rooms, votes([T] * count, centers)) is expected
    near = Rooms(scan=empty_room(SIDES_M, 1))
    vars(near)["near_given"] = fit(np.eye(4), 1.0)
    assert borne_out(T, near, votes([T] * count, centers)) is expected
    vars(rooms)["fits"] = []  # rooms that say nothing contradict nothing
    assert borne_out(T, rooms, votes([T] * count, centers))
