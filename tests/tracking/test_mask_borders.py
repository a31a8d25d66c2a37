"""What other scans show of an object mends the borders of its masks; a side that they did not see stays."""

import dataclasses

import numpy as np
import pytest
from factories import embedding
from furnished import cabinet, chair, corner
from scipy.spatial.transform import Rotation

from more2_jax.geometry.poses import apply_pose
from more2_jax.tracking.mask_borders import mend_borders
from more2_jax.tracking.objects import new_object, points_of, seen_again
from more2_jax.types import Instance, Observation

CODE = embedding(np.random.default_rng(0), np.zeros(3))
ROOM = corner()
BEFORE, NOW = chair(1), chair(11)  # the same chair, as two scans sample it
CABINET, LATER = cabinet(2), cabinet(12)


def pose(turn, shift):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    T[:3, 3] = shift
    return T


ELSEWHERE = pose([0.3, -0.8, 1.9], [400.0, -30.0, 8.0])


def seen(T=None, scan=1, **changes):
    T_ref_scan = np.eye(4) if T is None else np.linalg.inv(T)
    found = Observation(scan=scan, instance=7, T_ref_scan=T_ref_scan, score=0.9, rms_m=0.01, converged=True)
    return dataclasses.replace(found, **changes)


def known(then, now, number=0, T=None, **changes):
    """An object that scan 0 shows by `then`, and scan 1, whose frame lies at T, by `now`."""
    T = np.eye(4) if T is None else T
    o = new_object(number, 0, Instance(id=3, points=then), CODE)
    return seen_again(o, Instance(id=7, points=apply_pose(T, now)), seen(T, **changes))


def mended(objects, backgrounds, T=None):
    T = np.eye(4) if T is None else T
    then, now = backgrounds
    return mend_borders(objects, range(len(objects)), 1, {0: then, 1: apply_pose(T, now)})


def as_set(points):
    return set(map(bytes, np.round(points, 6) + 0.0))


def shown(o, scan, T=None):
    """What a scan shows of the object, in the frame of scan 0."""
    return as_set(apply_pose(o.observations[scan].T_ref_scan, points_of(o, o.observations[scan])))


@pytest.mark.parametrize("scan", [0, 1])
def test_what_was_cut_off_comes_back_into_the_scan_that_lost_it(scan):
    clouds, cut = [BEFORE, NOW], [BEFORE, NOW][scan][:, 2] > 0.45
    backgrounds = [ROOM, ROOM]
    backgrounds[scan] = np.concatenate([ROOM, clouds[scan][cut]])
    clouds[scan] = clouds[scan][~cut]
    (o,), (repair,) = mended([known(*clouds)], backgrounds)
    back = shown(o, scan) - as_set(clouds[scan])
    lost = as_set([BEFORE, NOW][scan][cut])
    assert len(back & lost) > 0.98 * len(lost)
    assert not back - lost  # no floor under it, no wall
    assert shown(o, 1 - scan) == as_set(clouds[1 - scan])
    assert (repair.regained, repair.points, repair.dropped) == (len(back), len(clouds[scan]), 0)
    assert repair.instances == ((7,) if scan == 1 else ())  # of an earlier scan: not named


def test_a_side_that_was_not_seen_before_stays():
    front = BEFORE[:, 0] < 1.35
    (o,), repairs = mended([known(BEFORE[front], NOW)], [ROOM, ROOM])
    assert not repairs and shown(o, 1) == as_set(NOW)


def test_clean_masks_stay_as_they_are():
    objects = [known(BEFORE, NOW), known(CABINET, LATER, 1)]
    same, repairs = mended(objects, [ROOM, ROOM])
    assert not repairs and all(a is b for a, b in zip(objects, same, strict=True))


def dirty(T=None):
    """The chair's mask in the later scan holds the near edge of the cabinet's side too."""
    edge = LATER[:, 0] < 2.01
    patch = edge & (LATER[:, 2] > 0.5)
    objects = [
        known(BEFORE, np.concatenate([NOW, LATER[patch]]), T=T),
        known(CABINET, LATER[~patch], 1, T=T),
    ]
    return objects, as_set(LATER[patch])


def test_a_neighbors_points_go_to_the_neighbor():
    objects, patch = dirty()
    (seat, other), repairs = mended(objects, [ROOM, ROOM])
    assert len(shown(seat, 1) & patch) < 0.05 * len(patch)
    assert shown(seat, 1) | patch >= as_set(NOW)
    assert len(patch - shown(other, 1)) < 0.05 * len(patch)
    lost, gained = repairs
    assert (lost.object, lost.neighbor, lost.instances) == ("object_000", "object_001", (7,))
    assert (gained.object, gained.neighbor) == ("object_001", None)
    assert lost.dropped == gained.regained > 0.95 * len(patch) and lost.share > 0.9
    assert shown(seat, 0) == as_set(BEFORE) and shown(other, 0) == as_set(CABINET)


def test_of_two_objects_in_one_mask_none_is_dropped():
    both = known(BEFORE, np.concatenate([NOW, LATER]))
    objects = [both, known(CABINET, LATER[LATER[:, 2] > 0.85], 1)]
    (o, _), _ = mended(objects, [ROOM, ROOM])
    assert shown(o, 1) == as_set(np.concatenate([NOW, LATER]))


def test_no_frame_matters():
    objects, _ = dirty()
    moved, _ = dirty(ELSEWHERE)
    for a, b in zip(mended(objects, [ROOM, ROOM])[0], mended(moved, [ROOM, ROOM], ELSEWHERE)[0], strict=True):
        np.testing.assert_array_equal(a.point_scan, b.point_scan)
        np.testing.assert_allclose(a.points, b.points, atol=1e-9)


def test_observations_in_doubt_mend_nothing():
    cut = NOW[:, 2] > 0.45
    o = known(BEFORE, NOW[~cut], accumulated=False)
    (same,), repairs = mended([o], [ROOM, np.concatenate([ROOM, NOW[cut]])])
    assert same is o and not repairs


def test_what_two_scans_showed_before_is_not_mended_again():
    cut = BEFORE[:, 2] > 0.45
    o = known(BEFORE[~cut], NOW)
    o = seen_again(o, Instance(id=9, points=chair(21)), seen(scan=2))
    background = np.concatenate([ROOM, BEFORE[cut]])
    (same,), repairs = mend_borders([o], [0], 2, {0: background, 1: background, 2: ROOM})
    assert same is o and not repairs


def test_points_that_come_back_have_no_known_normals():
    cut = NOW[:, 2] > 0.45
    o = dataclasses.replace(known(BEFORE, NOW[~cut]), mesh=None)
    o = dataclasses.replace(o, normals=np.tile([0.0, 0.0, 1.0], (len(o.points), 1)))
    (more,), _ = mended([o], [ROOM, np.concatenate([ROOM, NOW[cut]])])
    assert more.normals is not None and len(more.normals) == len(more.points) == len(more.point_scan)
    np.testing.assert_array_equal(more.normals[: len(o.points)], o.normals)
    assert len(more.points) > len(o.points) and not more.normals[len(o.points) :].any()
