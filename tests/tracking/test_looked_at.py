"""Removed or not seen, added or discovered: a scan that shows neither an object nor the floor under it did not look."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import KDTree

from more2_jax.config import preset
from more2_jax.geometry.poses import apply_pose
from more2_jax.tracking.changes import changes_between, last_known, not_seen_in
from more2_jax.tracking.looked_at import (
    CELL_M,
    LOOKED_AT,
    SPACINGS,
    STILL_THERE,
    Columns,
    cannot_tell,
    looked_at,
    looked_at_upright,
    not_looked_at,
    not_looked_at_before,
    spacing_of,
    with_not_seen,
)
from more2_jax.tracking.objects import new_object, seen_again
from more2_jax.types import Embedding, Frame, Instance, Observation, Scan, ScanRecord

RNG = np.random.default_rng(0)
CODE = Embedding(
    inv=np.ones(2), eqv=np.ones((3, 2)), scale=np.ones(()), center=np.zeros(3), origin=np.zeros(3)
)
ID = ("object_000",)
CONFIG = preset("robust", upright=True)
BOX = RNG.uniform([-0.4, -0.3, 0.0], [0.4, 0.3, 0.8], (500, 3)) + [2.0, 1.0, 0.0]


def floor(low, high, height=0.0, count=4000):
    points = RNG.uniform([*low, 0.0], [*high, 0.0], (count, 3))
    return points + [0.0, 0.0, height]


def scan(background, *clouds):
    instances = tuple(Instance(id=k + 1, points=c) for k, c in enumerate(clouds))
    return Scan(name="later", source="", instances=instances, background=background)


def place(T=None):
    """A box, seen in scan 0, whose scan lies in the scene's frame as `T` says."""
    return new_object(0, 0, Instance(id=1, points=BOX), CODE, Frame() if T is None else Frame(T_scene_scan=T))


def missed(background, *clouds, T=None, upright=True, o=None):
    frame = Frame() if T is None else Frame(T_scene_scan=T)
    return not_looked_at([o or place()], [0], scan(background, *clouds), frame, upright)


@pytest.mark.parametrize("upright", [True, False])
def test_of_a_place_in_an_unknown_frame_no_scan_says_that_it_did_not_look(upright):
    elsewhere = floor([-4, 0], [1.4, 3])
    lost = new_object(0, 0, Instance(id=1, points=BOX), CODE, Frame(unknown=True))
    assert missed(elsewhere, upright=upright) == ID
    assert missed(elsewhere, upright=upright, o=lost) == ()


@pytest.mark.parametrize("upright", [True, False])
def test_bare_floor_where_it_stood_says_removed_and_none_says_not_seen(upright):
    assert missed(floor([0, 0], [4, 3]), upright=upright) == ()
    assert missed(floor([-4, 0], [1.4, 3]), upright=upright) == ID


def test_half_a_place_is_enough_and_a_corner_of_it_is_not():
    for share, said in ((0.6, ()), (0.2, ID)):
        edge = 1.6 + 0.8 * share
        assert missed(floor([-4, 0], [edge, 3])) == said
    assert 0.2 < LOOKED_AT < 0.6


def test_what_stands_there_instead_was_looked_at():
    other = BOX @ np.diag([0.8, 0.8, 1.2]) + [0.4, 0.2, 0.0]
    far = floor([-4, 0], [1, 3])
    assert missed(far, other) == ()
    assert missed(far) == ID


def test_a_ceiling_or_a_lamp_over_the_place_tells_nothing():
    assert missed(np.concatenate([floor([-4, 0], [1, 3]), floor([0, 0], [4, 3], 2.5)])) == ID


def test_a_scan_without_background_or_of_unknown_frame_cannot_tell():
    assert missed(np.zeros((0, 3))) == ()
    far = scan(ELSEWHERE)
    assert not_looked_at([place()], [0], far, Frame(), True) == ID
    assert not_looked_at([place()], [0], far, Frame(unknown=True), True) == ()


def test_it_is_the_scans_place_in_the_scene_that_counts():
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], [1.0, 2.0, 0.3]
    there = floor([1, 0], [3, 2])
    assert missed(apply_pose(np.linalg.inv(T), there), T=T) == ()
    assert missed(there, T=T) == ID


def test_the_last_place_is_looked_for_not_the_first():
    moved = np.eye(4)
    moved[0, 3] = 10.0  # the second scan saw it ten meters on
    seen = Observation(
        scan=1, instance=1, T_ref_scan=np.linalg.inv(moved), score=1.0, rms_m=0.0, converged=True
    )
    o = seen_again(place(), Instance(id=1, points=apply_pose(moved, BOX)), seen)
    assert missed(floor([0, 0], [4, 3]), o=o) == ID
    assert missed(floor([10, 0], [14, 3]), o=o) == ()


def test_shares_are_of_the_place():
    whole = floor([0, 0], [4, 3])
    assert looked_at_upright(BOX, Columns([whole])) == 1.0 == looked_at(BOX, KDTree(BOX + 0.01))
    away = whole + [50, 0, 0]
    assert looked_at_upright(BOX, Columns([away])) == 0.0 == looked_at(BOX, KDTree(away))


def test_an_object_not_looked_for_is_compared_with_the_scan_that_saw_it_last():
    pose = np.eye(4)
    pose[0, 3] = -1.0
    back = Observation(scan=2, instance=4, T_ref_scan=pose, score=1.0, rms_m=0.0, converged=True)
    o = seen_again(place(), Instance(id=4, points=BOX + [1.0, 0, 0]), back)
    records = [
        ScanRecord(index=k, name="", source="", instances=(), not_seen=(o.id,) if k == 1 else ())
        for k in range(4)
    ]
    seen = not_seen_in(records)
    assert changes_between([o], 0, 1, CONFIG, not_seen=seen).not_seen == (o.id,)
    assert changes_between([o], 1, 2, CONFIG, not_seen=seen).moved == (o.id,)
    assert changes_between([o], 2, 3, CONFIG, not_seen=seen).removed == (o.id,)
    assert last_known(o, 1, seen) is o.observations[0]
    nothing = changes_between([o], 0, 1, CONFIG), changes_between([o], 1, 2, CONFIG)
    assert nothing[0].removed == nothing[1].added == (o.id,)
    young = dataclasses.replace(o, observations=o.observations[1:], reference_scan=2)
    assert last_known(young, 1, seen) is None


# --- what is new where no scan had looked ---------------------------------------------------------------------------

THERE, ELSEWHERE = floor([0, 0], [4, 3]), floor([-4, 0], [1.4, 3])


def records(*backgrounds, frame=None):
    return tuple(
        ScanRecord(index=k, name="", source="", instances=(), background=b, frame=frame or Frame())
        for k, b in enumerate(backgrounds)
    )


def found_new(*backgrounds, upright=True, known=(), frame=None, own=None):
    """What is said of a box that the last of several scans has alone, and of which earlier scans it is not seen.

    `frame` is that of the earlier scans, `own` of the last.
    """
    scans, last = records(*backgrounds, frame=frame), len(backgrounds)
    new = new_object(1, last, Instance(id=1, points=BOX), CODE, own or Frame())
    unseen = not_looked_at_before(known, [new], scans, upright)
    changes = changes_between(
        [new], last - 1, last, CONFIG, not_seen=not_seen_in(with_not_seen(scans, unseen))
    )
    told = [k for k in ("added", "discovered", "not_seen", "removed") if getattr(changes, k)]
    return told, sorted(unseen)


@pytest.mark.parametrize("upright", [True, False])
def test_new_where_the_floor_was_bare_is_added_and_where_no_scan_looked_discovered(upright):
    assert found_new(THERE, upright=upright) == (["added"], [])
    assert found_new(ELSEWHERE, upright=upright) == (["discovered"], [0])


def test_it_came_since_the_last_scan_that_looked():
    assert found_new(THERE, ELSEWHERE) == (["added"], [1])
    assert found_new(ELSEWHERE, THERE) == (["added"], [])
    assert found_new(ELSEWHERE, ELSEWHERE, ELSEWHERE) == (["discovered"], [0, 1, 2])


def test_what_stood_there_before_was_looked_at():
    other = new_object(0, 0, Instance(id=1, points=BOX + [0.1, 0.1, 0.0]), CODE)
    assert found_new(ELSEWHERE, known=[other]) == (["added"], [])
    later = new_object(0, 1, Instance(id=1, points=BOX), CODE)
    assert found_new(ELSEWHERE, known=[later]) == (["discovered"], [0])  # that scan did not see it


def test_a_scan_that_cannot_tell_is_taken_to_have_looked():
    assert found_new(np.zeros((0, 3))) == (["added"], [])
    assert found_new(ELSEWHERE, frame=Frame(unknown=True)) == (["added"], [])
    assert found_new(ELSEWHERE, own=Frame(unknown=True)) == (["added"], [])  # where it stands nobody knows
    assert found_new(np.zeros((0, 3)), ELSEWHERE) == (["added"], [1])


def test_earlier_scans_lie_where_their_frames_say():
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], [30.0, 1.0, 0.2]
    there = apply_pose(np.linalg.inv(T), THERE)
    assert found_new(there, frame=Frame(T_scene_scan=T)) == (["added"], [])
    assert found_new(there) == (["discovered"], [0])


def test_few_points_of_a_wide_floor_are_a_look_and_a_room_keeps_its_columns():
    assert SPACINGS * spacing_of(floor([0, 0], [4, 3], count=6000)) < CELL_M
    wide = floor([-40, -30], [40, 30], count=6000)
    assert SPACINGS * spacing_of(wide) > 3 * CELL_M
    assert found_new(wide) == (["added"], [])
    assert looked_at_upright(BOX, Columns([wide])) < LOOKED_AT  # as a room's it would tell too little


def test_an_object_that_was_discovered_is_known_from_then_on():
    o = seen_again(
        new_object(1, 1, Instance(id=1, points=BOX), CODE),
        Instance(id=1, points=BOX),
        Observation(scan=2, instance=1, T_ref_scan=np.eye(4), score=1.0, rms_m=0.0, converged=True),
    )
    seen = {0: (o.id,)}
    assert changes_between([o], 0, 1, CONFIG, not_seen=seen).discovered == (o.id,)
    assert changes_between([o], 0, 2, CONFIG, not_seen=seen).discovered == (o.id,)
    assert changes_between([o], 1, 2, CONFIG, not_seen=seen).static == (o.id,)
    assert changes_between([o], 0, 1, CONFIG).added == (o.id,)


@pytest.mark.parametrize(
    ("scan", "not_seen", "told"),
    [(0, [], "removed"), (0, [1], "not_seen"), (1, [], "added"), (1, [0], "discovered")],
)
def test_whatever_one_scan_alone_has_is_told_with_its_probability(scan, not_seen, told):
    o = new_object(1, scan, Instance(id=1, points=BOX), CODE)
    unseen = {k: (o.id,) for k in not_seen}
    changes = changes_between([o], 0, 1, CONFIG, {o.id: 0.7, "another": 0.1}, unseen)
    assert getattr(changes, told) == (o.id,)
    assert changes.probability == {o.id: 0.7}


# --- what stands where it stood, without a mask ---------------------------------------------------------------------


def surface(box_low, box_high, count=3000):
    """Points on the faces of a box."""
    points = RNG.uniform(box_low, box_high, (count, 3))
    axis, side = RNG.integers(0, 3, count), RNG.integers(0, 2, count)
    points[np.arange(count), axis] = np.stack([box_low, box_high])[side, axis]
    return points


CABINET = surface([1.6, 0.7, 0.0], [2.4, 1.3, 0.8])


@pytest.mark.parametrize("upright", [True, False])
def test_a_surface_without_a_mask_is_neither_removed_nor_added(upright):
    o = new_object(0, 0, Instance(id=1, points=CABINET), CODE)
    again = surface([1.6, 0.7, 0.0], [2.4, 1.3, 0.8])
    bare, unmasked = THERE, np.concatenate([THERE, again])
    assert missed(bare, o=o, upright=upright) == ()
    assert missed(unmasked, o=o, upright=upright) == ID
    assert missed(bare, again, o=o, upright=upright) == ID  # in the mask of something else
    new = new_object(0, 1, Instance(id=1, points=CABINET), CODE)
    assert not_looked_at_before([], [new], records(bare), upright) == {}
    assert not_looked_at_before([], [new], records(unmasked), upright) == {0: ID}


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ([1.6, 0.7, 0.0], [2.0, 1.0, 0.5]),
        ([1.8, 0.9, 0.0], [2.2, 1.1, 0.7]),
        ([1.7, 0.8, 0.0], [2.5, 1.4, 0.9]),
    ],
)
def test_another_thing_in_its_place_is_not_itself(low, high):
    o = new_object(0, 0, Instance(id=1, points=CABINET), CODE)
    assert missed(np.concatenate([THERE, surface(low, high)]), o=o) == ()
    assert missed(THERE, surface(low, high), o=o) == ()


def test_a_wall_behind_it_and_the_floor_under_it_are_not_its_surface():
    wall = RNG.uniform([0, 1.32, 0], [4, 1.32, 2.5], (8000, 3))
    flat = new_object(0, 0, Instance(id=1, points=surface([1.6, 1.28, 0.3], [2.4, 1.31, 1.1])), CODE)
    assert missed(np.concatenate([THERE, wall]), o=flat) == ()
    low = new_object(0, 0, Instance(id=1, points=surface([1.6, 0.7, 0.0], [2.4, 1.3, 0.02])), CODE)
    assert missed(floor([0, 0], [4, 3], count=8000), o=low) == ()


@pytest.mark.parametrize(("noise_m", "there"), [(0.0, False), (0.01, False), (0.03, True)])
def test_among_noise_a_surface_that_lies_farther_off_is_still_it(noise_m, there):
    o = new_object(0, 0, Instance(id=1, points=CABINET), CODE)
    frame, off = Frame(noise_m=noise_m), surface([1.6, 0.7, 0.0], [2.4, 1.3, 0.8]) + 0.05
    assert not_looked_at([o], [0], scan(THERE, off), frame, True) == (ID if there else ())
    new = new_object(0, 1, Instance(id=1, points=CABINET), CODE, frame)
    unseen = not_looked_at_before([], [new], records(np.concatenate([THERE, off])), True)
    assert unseen == ({0: ID} if there else {})


def test_half_of_it_says_so_and_many_places_are_told_as_one_by_one():
    def clouds(share):
        yield THERE
        yield CABINET[CABINET[:, 0] < 1.6 + 0.8 * share]

    assert 0.3 < STILL_THERE < 0.8
    for share, unsure in ((0.2, False), (0.9, True)):
        assert cannot_tell([CABINET], lambda s=share: clouds(s), True) == [unsure]
        others = [CABINET + [dx, 0, 0] for dx in (-0.9, 0.9)]
        together = cannot_tell([CABINET, *others], lambda s=share: clouds(s), True)
        assert together == [unsure, *(cannot_tell([p], lambda s=share: clouds(s), True)[0] for p in others)]
