"""Masks that show an object in pieces are joined by the scan that saw it whole; nothing else is."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from more2_jax.geometry.poses import apply_pose
from more2_jax.tracking.objects import new_object, next_number, points_of
from more2_jax.tracking.split_masks import joined, mend_splits, share_on
from more2_jax.types import Color, Embedding, Frame, Instance, Observation, Repair, ScanRecord

RNG = np.random.default_rng(0)
CODE = Embedding(
    inv=jnp.ones(2), eqv=jnp.ones((3, 2)), scale=jnp.ones(()), center=jnp.zeros(3), origin=np.zeros(3)
)


def pose(angle_deg, shift):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", angle_deg, degrees=True).as_matrix()
    T[:3, 3] = shift
    return T


def bench(seed, count=3000):
    """The surface of a bench: a seat, a back, two sides."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(size=(count, 2))
    kind = rng.integers(4, size=count)
    seat = np.stack([1.6 * u[:, 0], 0.5 * u[:, 1], np.full(count, 0.45)], axis=1)
    back = np.stack([1.6 * u[:, 0], np.zeros(count), 0.9 * u[:, 1]], axis=1)
    sides = [np.stack([np.full(count, x), 0.5 * u[:, 0], 0.45 * u[:, 1]], axis=1) for x in (0.0, 1.6)]
    return np.choose(kind[:, None], [seat, back, *sides])


WHOLE = bench(0)
MOVED = pose(70, [3.0, 1.0, 0.0])  # where the later scan saw it
SEEN = bench(1)
LEFT, RIGHT = SEEN[:, 0] < 0.9, SEEN[:, 0] >= 0.9


def instance(points, id_=1, **more):
    return Instance(id=id_, points=points, **more)


def observed(T_ref_scan, **changes):
    seen = Observation(scan=1, instance=1, T_ref_scan=T_ref_scan, score=0.9, rms_m=0.01, converged=True)
    return dataclasses.replace(seen, **changes)


def now_in_two(extra=(), **changes):
    """A bench known whole; the later scan has it in two parts, of which the first was matched."""
    parts = [instance(apply_pose(MOVED, SEEN[rows]), k + 1) for k, rows in enumerate((LEFT, RIGHT))]
    known = [new_object(0, 0, instance(WHOLE), CODE)]
    return mend_splits(known, [*parts, *extra], [(0, 0)], [observed(np.linalg.inv(MOVED), **changes)])


def test_a_part_left_over_joins_the_one_that_was_matched():
    mended = now_in_two()
    assert (
        mended.instance_parts == {1}
        and not mended.object_parts
        and not any(r.absorbed for r in mended.repairs)
    )
    assert mended.instances[0].id == 1 and len(mended.instances[0].points) == len(SEEN)
    (repair,) = mended.repairs
    assert (repair.object, repair.instances, repair.absorbed) == ("object_000", (1, 2), ())
    assert repair.share > 0.95


def test_another_object_beside_it_does_not():
    beside = instance(apply_pose(MOVED @ pose(0, [0.2, 0.7, 0.0]), bench(2)), 3)
    mended = now_in_two([beside])
    assert mended.instance_parts == {1}
    assert [r.instances for r in mended.repairs] == [(1, 2)]


@pytest.mark.parametrize("changes", [{"converged": False}, {"misfit": 0.8}])
def test_a_pose_in_doubt_joins_nothing(changes):
    assert not now_in_two(**changes).repairs


@pytest.mark.parametrize("changes", [{"converged": False}, {"misfit": 0.8}])
def test_what_stayed_needs_no_pose_that_fits(changes):
    """A part fits the whole badly both ways; that it lies on the whole where nothing moved is enough."""
    frame = Frame(T_scene_scan=np.linalg.inv(MOVED))
    (repair,) = now_in_two(frame=frame, **changes).repairs
    assert repair.instances == (1, 2)
    off = Frame(T_scene_scan=pose(0, [0.0, 0.0, 0.4]) @ frame.T_scene_scan)
    assert not now_in_two(frame=off, **changes).repairs
    lost = dataclasses.replace(frame, unknown=True)
    assert not now_in_two(frame=lost, **changes).repairs


def test_the_pose_decides_not_the_likeness():
    """The same two parts, with a pose that lays the first elsewhere: the second does not lie on the whole."""
    parts = [instance(apply_pose(MOVED, SEEN[rows]), k + 1) for k, rows in enumerate((LEFT, RIGHT))]
    known = [new_object(0, 0, instance(WHOLE), CODE)]
    elsewhere = np.linalg.inv(MOVED @ pose(180, [0.5, 0.3, 0.0]))
    assert not mend_splits(known, parts, [(0, 0)], [observed(elsewhere)]).repairs


def test_parts_known_before_are_one_when_the_whole_is_seen():
    known = [new_object(k, 0, instance(WHOLE[rows], k + 1), CODE) for k, rows in enumerate(halves(WHOLE))]
    other = new_object(2, 0, instance(WHOLE + [0.0, 2.0, 0.0], 9), CODE)
    whole = instance(apply_pose(MOVED, SEEN), 5)
    seen = observed(np.linalg.inv(MOVED), instance=5)
    mended = mend_splits([*known, other], [whole], [(0, 0)], [seen])
    assert [r.absorbed for r in mended.repairs] == [("object_001",)] and mended.object_parts == {1}
    assert [o.id for o in mended.whole(mended.objects)] == ["object_000", "object_002"]
    together = mended.objects[0]
    np.testing.assert_allclose(
        np.sort(points_of(together, together.observations[0]), axis=0), np.sort(WHOLE, axis=0), atol=1e-12
    )
    left = mended.whole(mended.objects)
    assert next_number(left, ()) == 3
    gone = Repair(object="object_000", absorbed=("object_008",))
    scan = ScanRecord(index=1, name="", source="", instances=(), repairs=(gone,))
    assert next_number(left, [scan]) == 9  # no id is given twice


def halves(points):
    return points[:, 0] < 0.9, points[:, 0] >= 0.9


def test_what_was_seen_apart_in_other_scans_is_not_absorbed():
    known = [new_object(k, 0, instance(WHOLE[rows], k + 1), CODE) for k, rows in enumerate(halves(WHOLE))]
    again = observed(np.eye(4), scan=1)
    known[1] = dataclasses.replace(known[1], observations=(*known[1].observations, again))
    whole = instance(apply_pose(MOVED, SEEN), 5)
    later = observed(np.linalg.inv(MOVED), scan=2)
    assert not mend_splits(known, [whole], [(0, 0)], [later]).repairs


def test_nothing_found_mends_nothing():
    known = [new_object(0, 0, instance(WHOLE), CODE)]
    mended = mend_splits(known, [instance(SEEN)], [], [])
    assert not mended.repairs and mended.objects == known


def test_share_is_that_of_the_part_and_no_frame_matters():
    half = WHOLE[LEFT_OF_WHOLE := WHOLE[:, 0] < 0.9]
    assert LEFT_OF_WHOLE.any() and share_on(WHOLE, half) == 1.0
    assert share_on(half, WHOLE) == pytest.approx(len(half) / len(WHOLE), abs=0.08)
    T = pose(33, [400.0, -900.0, 2.0])
    assert share_on(apply_pose(T, half), apply_pose(T, WHOLE)) == pytest.approx(
        share_on(half, WHOLE), abs=1e-3
    )
    assert share_on(WHOLE, WHOLE + [0, 0, 5.0]) == 0.0


def test_joined_keeps_what_all_parts_have():
    rgb = np.full((3, 3), 7, np.uint8)
    a, b = instance(np.zeros((3, 3)), 4, colors=rgb), instance(np.ones((2, 3)), 6, colors=rgb[:2])
    one = joined(a, [b])
    assert one.id == 4 and len(one.points) == 5 and len(one.colors) == 5
    assert joined(a, [dataclasses.replace(b, colors=None)]).colors is None


def test_color_of_a_whole_is_that_of_its_parts():
    known = [
        dataclasses.replace(
            new_object(k, 0, instance(WHOLE[rows], k + 1), CODE),
            color=Color(points=int(rows.sum()), lab=np.full(3, float(k))),
        )
        for k, rows in enumerate(halves(WHOLE))
    ]
    whole = instance(apply_pose(MOVED, SEEN), 5)
    mended = mend_splits(known, [whole], [(0, 0)], [observed(np.linalg.inv(MOVED))])
    np.testing.assert_allclose(mended.objects[0].color.lab, halves(WHOLE)[1].mean())
