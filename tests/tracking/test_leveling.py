"""Tilted scans: what is said of level ones is said of them, in terms of the scans as they were given."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from factories import living_scene, scene_object, turn_z
from scipy.spatial.transform import Rotation
from small_scenes import CONFIG, in_frame, room, scan

from more2_jax.config import preset
from more2_jax.geometry.poses import apply_pose
from more2_jax.geometry.up_axis import R_UP
from more2_jax.meshing.object_mesh import object_floor
from more2_jax.scene import add_scan, leveled_scan, start_scene
from more2_jax.tracking import leveling
from more2_jax.tracking.accumulated import accumulated_object
from more2_jax.tracking.leveling import (
    LEAST_TILT_DEG,
    as_given,
    level_by_objects,
    level_of,
    leveled,
    shows_floor,
)
from more2_jax.tracking.objects import place_of, points_of
from more2_jax.tracking.relocalize import known_object
from more2_jax.types import Frame, LivingScene, Scan

pytestmark = [pytest.mark.optimized, pytest.mark.no_cover]

FIRST = {0: (0.0, 0.0), 1: (0.3, 3.0), 2: (0.0, 6.0)}
THEN = {0: (0.0, 0.0), 1: (1.2, 4.0), 2: (0.0, 6.0)}  # kind 1 moved
NOTHING = np.zeros((0, 3))
SAME = np.eye(4)
FLOOR_M = -0.75  # below all pieces


def visit(name: str, poses: dict, seed: int) -> Scan:
    return dataclasses.replace(scan(name, poses), background=room(FLOOR_M, seed))


A, B = visit("a", FIRST, 0), visit("b", THEN, 1)


def tilt(s: Scan, angle_deg: float, about_deg: float) -> np.ndarray:
    """T_tilted_scan: a turn about a level axis through the middle of the scan's background."""
    axis = [np.cos(np.deg2rad(about_deg)), np.sin(np.deg2rad(about_deg)), 0.0]
    middle = np.median(s.background, axis=0)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(angle_deg * np.array(axis), degrees=True).as_matrix()
    T[:3, 3] = middle - T[:3, :3] @ middle
    return T


def visited(prior, first: Scan, second: Scan) -> LivingScene:
    return add_scan(prior, start_scene(prior, first, CONFIG), second, CONFIG)


@pytest.fixture(scope="module")
def level_scene(tiny_prior):
    """Both scans level, in one frame."""
    return visited(tiny_prior, A, B)


@pytest.fixture(scope="module")
def tilts():
    return tilt(A, 5.0, 20.0), tilt(B, 5.0, 160.0)


@pytest.fixture(scope="module")
def tilted_scene(tiny_prior, tilts):
    """The same scans, each tilted by 5° another way."""
    return visited(tiny_prior, in_frame(A, tilts[0]), in_frame(B, tilts[1]))


def relative(scene: LivingScene) -> list[np.ndarray]:
    """T_first_second of every object seen twice, between the scans as they were given."""
    pairs = [o.observations for o in scene.objects if len(o.observations) == 2]
    return [np.linalg.inv(a.T_ref_scan) @ b.T_ref_scan for a, b in pairs]


def said(scene: LivingScene) -> list:
    changes = [dataclasses.replace(c, probability={}) for c in scene.changes]
    return [*changes, *[[(s.scan, s.instance) for s in o.observations] for o in scene.objects]]


def assert_same_but_for(T_first: np.ndarray, T_second: np.ndarray, found: LivingScene, level: LivingScene):
    """The same matches and changes; poses differ by the motions of the scans, to 0.2° and 1 cm."""
    assert said(found) == said(level)
    assert_poses_but_for(T_first, T_second, found, level)


def assert_poses_but_for(T_first: np.ndarray, T_second: np.ndarray, found: LivingScene, level: LivingScene):
    """Poses differ by the motions of the scans."""
    for T, expected in zip(relative(found), relative(level), strict=True):
        T = np.linalg.inv(T_first) @ T @ T_second
        np.testing.assert_allclose(T[:3, :3], expected[:3, :3], atol=np.deg2rad(0.2))
        np.testing.assert_allclose(T[:3, 3], expected[:3, 3], atol=0.01)


def test_scans_tilted_each_another_way_are_compared_as_if_level(tilted_scene, level_scene, tilts):
    assert level_scene.changes[0].moved == ("object_001",)
    assert_same_but_for(*tilts, tilted_scene, level_scene)
    for s, T in zip(tilted_scene.scans, tilts, strict=True):
        np.testing.assert_allclose(s.frame.T_scene_scan @ T, np.eye(4), atol=0.01)
        assert s.frame.tilt_deg == pytest.approx(5.0, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("which", [0, 1])
def test_one_tilted_scan_is_compared_as_if_it_were_not(tiny_prior, level_scene, tilts, which):
    T = [SAME, SAME]
    T[which] = tilts[which]
    found = visited(tiny_prior, in_frame(A, T[0]), in_frame(B, T[1]))
    assert_same_but_for(*T, found, level_scene)
    assert found.scans[1 - which].frame.tilt_deg == 0.0


def test_scans_that_share_a_tilted_frame_go_on_sharing_it(tiny_prior, level_scene, tilts):
    T = tilts[0]
    found = visited(tiny_prior, in_frame(A, T), in_frame(B, T))
    assert_same_but_for(T, T, found, level_scene)
    first, second = (s.frame.T_scene_scan for s in found.scans)
    np.testing.assert_array_equal(first, second)


def test_points_lie_level_and_single_observations_are_had_back_as_given(tilted_scene, tilts):
    for o in tilted_scene.objects:
        for seen, s, T in zip(o.observations, (A, B), tilts, strict=True):
            given = next(i for i in s.instances if i.id == seen.instance)
            np.testing.assert_allclose(points_of(o, seen), apply_pose(T, given.points), atol=1e-9)
            assert seen.frame is tilted_scene.scans[seen.scan].frame
        reference = o.observations[0]
        np.testing.assert_array_equal(reference.T_ref_scan, tilted_scene.scans[0].frame.T_scene_scan)
        np.testing.assert_allclose(place_of(reference), np.eye(4), atol=1e-9)


@pytest.mark.parametrize("accumulate", [True, False])
def test_a_later_scan_is_compared_with_what_lies_level(tilted_scene, accumulate):
    config = dataclasses.replace(CONFIG, accumulate_target=accumulate)
    o = tilted_scene.objects[0]
    known, T_ref_scene = known_object(o, None, config)
    chosen = o.points if accumulate else o.points[o.point_scan == 0]
    np.testing.assert_allclose(apply_pose(T_ref_scene, known.points), chosen, atol=1e-9)
    first = o.observations[0]
    there = place_of(o.observations[-1] if accumulate else first)
    np.testing.assert_allclose(known.points, apply_pose(there, chosen), atol=1e-9)


def test_the_floor_under_an_object_of_a_tilted_scan_is_level_where_its_points_are(tilted_scene):
    config = preset("robust", upright=True)
    for o in tilted_scene.objects:
        assert object_floor(accumulated_object(o, tilted_scene.scans), config) == pytest.approx(
            FLOOR_M, abs=0.01
        )


def test_level_scans_are_compared_to_the_last_bit_as_without_leveling(monkeypatch, tiny_prior, level_scene):
    monkeypatch.setattr(leveling, "gravity", lambda _: None)
    plain = visited(tiny_prior, A, B)
    for mine, its in zip(level_scene.objects, plain.objects, strict=True):
        np.testing.assert_array_equal(mine.points, its.points)
        for a, b in zip(mine.observations, its.observations, strict=True):
            np.testing.assert_array_equal(a.T_ref_scan, b.T_ref_scan)
            assert (a.score, a.rms_m, a.misfit) == (b.score, b.rms_m, b.misfit)


@pytest.mark.parametrize("angle_deg", [0.0, 0.8 * LEAST_TILT_DEG])
def test_a_scan_that_is_level_is_left_alone(angle_deg):
    s = in_frame(A, tilt(A, angle_deg, 40.0))
    T = level_of(s.background)
    np.testing.assert_array_equal(T, np.eye(4))
    assert leveled(s, T) is s
    frame = Frame()
    assert as_given([], 0, frame, T)[1] is frame


def test_without_a_floor_or_in_any_orientation_nothing_is_leveled():
    s = in_frame(A, tilt(A, 5.0, 40.0))
    bare = dataclasses.replace(s, background=NOTHING)
    free = dataclasses.replace(CONFIG, upright=False)
    for one, config in ((bare, CONFIG), (s, free)):
        found, T = leveled_scan(one, config)
        assert found is one
        np.testing.assert_array_equal(T, np.eye(4))
    assert leveled_scan(s, CONFIG)[0] is not s


def test_what_the_first_scans_leveling_does_not_level_is_leveled_by_its_own_floor():
    first = level_of(apply_pose(tilt(A, 5.0, 0.0), A.background))
    other = apply_pose(tilt(B, 5.0, 90.0), B.background)
    T = level_of(other, first)
    assert not np.array_equal(T, first)
    np.testing.assert_allclose(T @ tilt(B, 5.0, 90.0), np.eye(4), atol=0.01)
    same = apply_pose(tilt(A, 5.0, 0.0), B.background)
    assert level_of(same, first) is first
    assert level_of(NOTHING, first) is first  # as far as is known they share a frame


def test_a_leveled_scan_turned_about_the_vertical_keeps_its_tilt():
    T = turn_z(1.0, np.zeros(3), np.ones(3)) @ tilt(A, 7.0, 30.0)
    assert Frame(T_scene_scan=T).tilt_deg == pytest.approx(7.0)
    assert Frame().tilt_deg == Frame(T_scene_scan=turn_z(1.0, np.zeros(3), np.ones(3))).tilt_deg == 0.0


OPEN = dataclasses.replace(CONFIG, upright=None)


@pytest.mark.parametrize("tilt_deg", [pytest.param(0.0, marks=pytest.mark.slow), 5.0])
def test_where_nobody_says_a_level_floor_has_things_stay_upright(tiny_prior, tilt_deg):
    first = in_frame(A, tilt(A, tilt_deg, 20.0))
    made = add_scan(tiny_prior, start_scene(tiny_prior, first, OPEN), B, OPEN)
    told = add_scan(tiny_prior, start_scene(tiny_prior, first, CONFIG), B, CONFIG)
    assert made.upright and told.upright
    for a, b in zip(made.objects, told.objects, strict=True):
        assert np.array_equal(a.observations[-1].T_ref_scan, b.observations[-1].T_ref_scan)


@pytest.mark.parametrize("shown", [NOTHING, A.background[A.background[:, 2] > FLOOR_M + 0.2]])
def test_without_a_floor_they_may_turn_in_any_way(tiny_prior, shown):
    bare = dataclasses.replace(A, background=shown)
    assert not shows_floor(bare)
    assert not start_scene(tiny_prior, bare, OPEN).upright


@pytest.mark.parametrize("up", ["x", "y", "-x", "-y", "-z"])
def test_a_scan_on_its_side_shows_no_floor(up):
    assert shows_floor(A)
    T = np.eye(4)
    T[:3, :3] = R_UP[up].T
    lying = in_frame(A, T)
    assert not shows_floor(lying)


# --- a later scan without a floor -----------------------------------------------------------------------------


def bare(s: Scan) -> Scan:
    """Objects alone."""
    return dataclasses.replace(s, background=NOTHING)


@pytest.mark.parametrize("tilt_deg", [pytest.param(0.0, marks=pytest.mark.slow), 12.0])
def test_a_later_scan_without_a_floor_is_leveled_by_its_objects(tiny_prior, level_scene, tilt_deg):
    T = tilt(B, tilt_deg, 160.0)
    scene = start_scene(tiny_prior, A, OPEN)
    found = add_scan(tiny_prior, scene, in_frame(bare(B), T), OPEN)
    assert said(found)[1:] == said(level_scene)[1:]
    assert tilt_deg or said(found) == said(level_scene)  # what stayed is known only in a common frame
    assert_poses_but_for(SAME, T, found, level_scene)
    assert found.scans[1].frame.tilt_deg == pytest.approx(tilt_deg, abs=0.5)
    ups = [(a @ T)[:3, 2] for a in relative(found)]  # upright things stay so
    np.testing.assert_allclose(ups, [[0, 0, 1]] * 3, atol=np.deg2rad(0.5))


def found_with(ups: list[np.ndarray], T_level_first: np.ndarray = SAME) -> LivingScene:
    """A scene whose second scan shows objects with these directions up in it, and one that is new."""
    rotations = [Rotation.align_vectors([[0, 0, 1]], [up])[0].as_matrix() for up in ups]
    poses = [np.block([[R, np.ones((3, 1))], [np.zeros((1, 3)), 1.0]]) for R in rotations]
    objects = [scene_object(k, {0: SAME, 1: T}) for k, T in enumerate(poses)]
    first, second, _ = living_scene().scans
    first = dataclasses.replace(first, frame=Frame(T_scene_scan=T_level_first))
    return dataclasses.replace(
        living_scene(), objects=(*objects, scene_object(9, {1: SAME})), scans=(first, second)
    )


def way_up(tilt_deg: float, about_deg: float = 0.0) -> np.ndarray:
    """A direction so far off z."""
    return np.linalg.inv(tilt(A, tilt_deg, about_deg))[2, :3]


def test_up_is_where_most_objects_have_theirs():
    scene = found_with([way_up(10.0), way_up(11.0), way_up(9.0), way_up(90.0, 45.0)])
    T = level_by_objects(scene, B)
    assert T is not None
    np.testing.assert_allclose(T[:3, :3] @ way_up(10.0), [0, 0, 1], atol=np.deg2rad(0.1))
    middle = np.median(np.concatenate([i.points for i in B.instances]), axis=0)
    np.testing.assert_allclose(apply_pose(T, middle[None])[0], middle, atol=1e-9)


def test_what_few_objects_say_or_many_deny_is_not_believed():
    for ups in (
        [],
        [way_up(10.0)],
        [way_up(10.0), way_up(40.0)],
        [way_up(0.0)] * 2 + [way_up(30.0, k) for k in (0, 90, 180)],
    ):
        assert level_by_objects(found_with(ups), B) is None


def test_a_frame_that_is_shared_as_far_as_objects_tell_stays_shared():
    first = tilt(A, 7.0, 30.0)
    up = np.linalg.inv(first)[:3, 2]
    assert level_by_objects(found_with([up, up], first), B) is first


def test_where_objects_do_not_agree_they_stay_as_they_were_found(tiny_prior, monkeypatch):
    scene = start_scene(tiny_prior, A, OPEN)
    monkeypatch.setattr("more2_jax.scene.level_by_objects", lambda *_: None)
    found = add_scan(tiny_prior, scene, bare(B), OPEN)
    free = add_scan(tiny_prior, scene, bare(B), dataclasses.replace(CONFIG, upright=False))
    assert said(found) == said(free)
    for one, other in zip(relative(found), relative(free), strict=True):
        np.testing.assert_array_equal(one, other)
