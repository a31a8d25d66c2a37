"""Scans of other frames than the scene's: the same matches, poses that differ by the frame alone, the same motions."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from factories import turn_z
from small_scenes import CONFIG, in_frame, piece, room, scan

from more2_jax.geometry.floor import floor_height
from more2_jax.geometry.poses import vertical_shift
from more2_jax.matching.assignment import LogOdds
from more2_jax.matching.candidates import AlignedPairs
from more2_jax.network.embedding_batch import embed
from more2_jax.scene import add_scan, start_scene
from more2_jax.tracking.objects import motion_between
from more2_jax.tracking.rooms import Rooms
from more2_jax.tracking.scan_frame import sought_there
from more2_jax.tracking.scan_height import (
    BEGUN_APART_M,
    OUT_OF_REACH_M,
    Weighed,
    begins_at,
    best_vote,
    common_height,
    doubtful,
)
from more2_jax.types import Instance, LivingScene, ObservedObject, Scan

pytestmark = pytest.mark.optimized  # scenes run for longer than their programs compile

FIRST = {0: (0.0, 0.0), 1: (0.3, 3.0), 2: (0.0, 6.0)}
THEN = {0: (0.0, 0.0), 1: (1.2, 4.0), 2: (0.0, 6.0)}  # kind 1 moved
NOTHING = np.zeros((0, 3))


def visited(prior, second: Scan) -> LivingScene:
    return add_scan(prior, start_scene(prior, scan("a", FIRST), CONFIG), second, CONFIG)


@pytest.fixture(scope="module")
def together(tiny_prior):
    """Both scans in one frame."""
    return visited(tiny_prior, scan("b", THEN))


def same_but_for(T_own_scene: np.ndarray, scene: LivingScene, together: LivingScene, atol: float) -> None:
    """The same is said of all objects; `T_ref_scan` differs by the motion of the second scan's frame."""
    assert dataclasses.replace(scene.changes[0], probability={}) == dataclasses.replace(
        together.changes[0], probability={}
    )
    for mine, its in zip(scene.objects, together.objects, strict=True):
        assert [s.instance for s in mine.observations] == [s.instance for s in its.observations]
        expected = its.observations[1].T_ref_scan
        np.testing.assert_allclose(mine.observations[1].T_ref_scan @ T_own_scene, expected, atol=atol)
    np.testing.assert_allclose(scene.scans[1].frame.T_scene_scan @ T_own_scene, np.eye(4), atol=atol)


@pytest.mark.parametrize("height_m", [1.0, *(pytest.param(h, marks=pytest.mark.slow) for h in (-0.4, 0.05))])
def test_a_lifted_scan_is_matched_as_if_it_were_not(tiny_prior, together, height_m):
    assert together.changes[0].moved == ("object_001",)
    T = vertical_shift(height_m)
    same_but_for(T, visited(tiny_prior, in_frame(scan("b", THEN), T)), together, atol=5e-3)


def furnished(name: str, moved_m: float) -> Scan:
    """Five pieces of different sizes, of which the last stands elsewhere by `moved_m`."""
    clouds = [piece(k) for k in range(3)]
    clouds += [piece(0) * [1.5, 0.8, 1.6], piece(1) * [0.6, 1.7, 1.5]]
    places = [(0, 0, 0), (4, 1, 0), (1, 5, 0), (4, 4, 0), (-3 + moved_m, 3, 0)]
    instances = [
        Instance(id=k, points=c - [0, 0, c[:, 2].min()] + p)
        for k, (c, p) in enumerate(zip(clouds, places, strict=True))
    ]
    return Scan(name=name, source=name, instances=tuple(instances))


@pytest.mark.parametrize(
    ("turn_deg", "shift"),
    [(137.0, (7.0, -30.0, 1.3)), pytest.param(1.5, (0.04, 0.03, 0.0), marks=pytest.mark.slow)],
)
def test_a_scan_in_another_frame_shows_what_moved_in_the_scenes(tiny_prior, turn_deg, shift):
    first, second = furnished("a", 0.0), furnished("b", 1.0)
    T = turn_z(np.deg2rad(turn_deg), np.zeros(3), np.array(shift))
    made = add_scan(tiny_prior, start_scene(tiny_prior, first, CONFIG), in_frame(second, T), CONFIG)
    frame = made.scans[1].frame
    np.testing.assert_allclose(frame.T_scene_scan @ T, np.eye(4), atol=0.02)
    assert 0 < frame.sigma_m < 0.03
    ids = [o.id for o in made.objects]
    assert (made.changes[0].static, made.changes[0].moved) == (tuple(ids[:4]), (ids[4],))
    last = made.objects[4]
    distance_m, angle_deg = motion_between(last, *last.observations)
    assert distance_m == pytest.approx(1.0, abs=0.03)
    assert angle_deg < 1.5
    for o in made.objects[:4]:
        np.testing.assert_allclose(o.observations[1].T_ref_scan @ T, np.eye(4), atol=0.02)
        assert all(s.frame is made.scans[s.scan].frame or s.scan == 0 for s in o.observations)


def test_in_a_building_partners_are_sought_where_its_frame_has_them(tiny_prior):
    """Two rooms with the same pieces: by their looks alone each would be compared with the first room's."""
    rooms = [[i.points + [x, 0, 0] for i in furnished("a", 0.0).instances] for x in (0.0, 30.0)]
    clouds = [c for room in rooms for c in room]
    old, new = (
        [ObservedObject(points=c, embedding=e) for c, e in zip(moved, embed(tiny_prior, moved), strict=True)]
        for moved in (clouds, [c + [100.0, 0, 0] for c in clouds])
    )
    matcher = dataclasses.replace(CONFIG.matching, candidates=1)
    weighed = common_height(tiny_prior, old, new, matcher, Rooms())
    T = np.eye(4)
    T[0, 3] = -100.0
    sought = sought_there(tiny_prior, weighed, matcher, "upright", T)
    true = {(k, k) for k in range(len(clouds))}
    before, after = (set(map(tuple, w.odds.pairs.tolist())) for w in (weighed, sought))
    assert true <= after and not true <= before
    assert sought.height_m == weighed.height_m
    shift_of_pairs = sought.aligned.T_old_new[[p[0] == p[1] for p in sought.odds.pairs], 0, 0, 3]
    np.testing.assert_allclose(shift_of_pairs, -100.0, atol=0.1)


def test_scans_of_one_frame_keep_it_to_the_last_bit(together):
    np.testing.assert_array_equal(together.scans[1].frame.T_scene_scan, np.eye(4))


def test_one_object_put_on_a_table_does_not_lift_the_room(tiny_prior):
    second = scan("b", THEN)
    first = second.instances[0]
    on_table = dataclasses.replace(first, points=first.points + [0, 0, 0.7])
    found = visited(tiny_prior, dataclasses.replace(second, instances=(on_table, *second.instances[1:])))
    np.testing.assert_array_equal(found.scans[1].frame.T_scene_scan, np.eye(4))


def test_floors_propose_a_height_where_the_objects_do_not_agree(tiny_prior):
    """Nothing is common but one box and the floor: 1 m is found although no two pairs vote for it."""
    points = scan("a", {0: (0.0, 0.0)}).instances[0].points
    clouds = [points, points + [0.0, 0.0, 1.0]]
    old, new = (
        [ObservedObject(points=c, embedding=e)]
        for c, e in zip(clouds, embed(tiny_prior, clouds), strict=True)
    )
    rooms = Rooms(scene=room(0.0, 0), scan=room(1.0, 1))
    weighed = common_height(tiny_prior, old, new, CONFIG.matching, rooms)
    assert weighed.height_m == pytest.approx(-1.0, abs=0.01)
    assert weighed.odds.matrix()[0, 0] > 0


def test_a_floor_that_was_not_seen_does_not_lift_what_fits_without(tiny_prior):
    """The second scan shows a table top and no floor: the floors seem 0.7 m apart, and every piece says otherwise."""
    first = dataclasses.replace(scan("a", FIRST), background=room(0.0, 0))
    table = np.random.default_rng(0).uniform([0, 0, 0.7], [2, 1, 0.7], (3000, 3))
    second = dataclasses.replace(scan("b", THEN), background=table)
    found = add_scan(tiny_prior, start_scene(tiny_prior, first, CONFIG), second, CONFIG)
    np.testing.assert_array_equal(found.scans[1].frame.T_scene_scan, np.eye(4))


@pytest.mark.parametrize(
    ("odds", "expected", "believed"),
    [
        (np.diag([5.0, 5.0, 5.0]), np.diag([5.0, 5.0, 4.0]), False),  # not clearly more
        (np.diag([5.0, 5.0, 5.0]), np.diag([5.0, 5.0, 1.0]), True),
        (np.diag([5.0, 5.0, 5.0]), np.diag([5.0, 5.0, -1.0]), True),
        (np.diag([20.0, -1.0, -1.0]), np.diag([5.0, 5.0, 1.0]), False),  # more, but of fewer pairs
    ],
)
def test_a_height_is_believed_that_explains_clearly_more_and_loses_no_pair(odds, expected, believed):
    apart = -9.0 * (1 - np.eye(3))
    pairs = object.__new__(AlignedPairs)  # odds alone are looked at
    one, other = (Weighed(height_m=0.0, aligned=pairs, odds=LogOdds.of(x + apart)) for x in (odds, expected))
    assert one.overrules(other) == believed


def test_the_floor_is_the_lowest_full_layer():
    assert floor_height(NOTHING) is None
    assert floor_height(np.zeros((1, 3))) == 0.0
    for height in (0.0, -3.2, 700.0):
        stray = np.array([[0, 0, height - 1.5]] * 20)  # reflections below the floor
        assert floor_height(np.concatenate([room(height, 2), stray])) == pytest.approx(height, abs=0.01)


def test_votes_for_a_height_are_counted_near_one_another():
    votes, weights = np.array([0.5, 0.51, 0.49, 0.0, -2.0]), np.ones(5)
    assert best_vote(votes, weights) == pytest.approx(0.5, abs=1e-3)
    assert doubtful(votes, weights)
    assert not doubtful(np.array([0.5, 0.0, 3.0]), np.ones(3))  # none agree: as they are
    assert not doubtful(np.array([0.004, -0.004, 0.5]), np.ones(3))


def test_a_stray_point_far_away_changes_no_floor():
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-3, 3, (4000, 2)), 0.4 + 0.003 * rng.normal(size=4000)])
    strays = np.array([[0.0, 0, -1e9], [0, 0, 1e9]])
    assert floor_height(np.concatenate([floor, strays])) == pytest.approx(0.4, abs=0.01)


def test_lifts_that_are_near_begin_where_one_has_begun_and_near_ones_at_none():
    near, far = BEGUN_APART_M - 0.001, BEGUN_APART_M + 0.001
    for m in (1.5, -0.8):
        assert begins_at(m, [0.0]) == m
        assert begins_at(m + near, [0.0, m]) == begins_at(m - near, [0.0, m]) == m
        assert begins_at(m + far, [0.0, m]) == m + far
    assert begins_at(OUT_OF_REACH_M, [0.0, 0.12]) == begins_at(-0.05, [0.0, -0.12]) == 0.0
    assert begins_at(OUT_OF_REACH_M + 0.01, [0.0]) == OUT_OF_REACH_M + 0.01
