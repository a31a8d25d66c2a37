"""Parts of one object are joined where they touch, lie on one object, and explain it better together."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from boxes import box
from scipy.spatial.transform import Rotation

from more2_jax.geometry.poses import apply_pose
from more2_jax.tracking.comparison import Comparison
from more2_jax.tracking.joined_masks import (
    Join,
    ObjectParts,
    Parts,
    each_once,
    touch,
    with_instances_joined,
    with_objects_joined,
)
from more2_jax.tracking.objects import new_object
from more2_jax.tracking.regrouped import JoinedMask, Regrouped
from more2_jax.types import Embedding, Instance, Observation

CODE = Embedding(
    inv=jnp.ones(2), eqv=jnp.ones((3, 2)), scale=jnp.ones(()), center=jnp.zeros(3), origin=np.zeros(3)
)
WHOLE = box(0, [1.6, 0.5, 0.4], [0, 0, 0], 3000)
SEEN = box(1, [1.6, 0.5, 0.4], [0, 0, 0], 3000)
MIDDLE = np.median(SEEN[:, 0])
LEFT, RIGHT = SEEN[SEEN[:, 0] < MIDDLE], SEEN[SEEN[:, 0] >= MIDDLE]
BESIDE = box(2, [0.5, 0.5, 0.4], [1.2, 0.0, 0.0], 1000)  # 15 cm from the box


@pytest.mark.parametrize("direction", [[1, 0, 0], [0, 0, 1], [1, 2, 3], [-3, 1, 0.2]])
def test_halves_of_one_surface_touch_wherever_it_is_cut(direction):
    height = SEEN @ np.array(direction)
    side = height > np.median(height)
    assert touch(SEEN[side], SEEN[~side]) and touch(SEEN[~side], SEEN[side])


@pytest.mark.parametrize("gap_m", [0.1, 0.3])
def test_what_stands_apart_does_not(gap_m):
    other = LEFT + [0.8 + gap_m, 0, 0]  # to the right half's left side
    assert not touch(LEFT, other) and not touch(other, LEFT)


def test_a_few_stray_points_do_not():
    """Of another object's points, where masks are a little wrong."""
    stray = WHOLE[:5] + 1e-3
    assert not touch(WHOLE, np.concatenate([SEEN + [3.0, 0, 0], stray]))


def test_one_point_given_many_times_touches_nothing():
    point = np.repeat(WHOLE[:1], 50, axis=0)
    assert not touch(point, point) and not touch(point, WHOLE) and not touch(WHOLE, point)


def pose(axes, angles):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler(axes, angles, degrees=True).as_matrix()
    T[:3, 3] = [1.0, -2.0, 0.5]
    return T


def test_touching_has_no_frame_no_order_and_no_doubled_points():
    T, rng = pose("xyz", [20, 70, 130]), np.random.default_rng(0)
    for one, other, together in ((LEFT, RIGHT, True), (LEFT, LEFT + [1.2, 0, 0], False)):
        moved = [apply_pose(T, rng.permutation(c)) for c in (one, other)]
        assert touch(*moved) == together
        assert touch(np.concatenate([one, one]), other) == together


def told(even_odds):
    """A comparison of which nothing is known but what an even chance is."""
    return object.__new__(type("Told", (Comparison,), {"even_odds": even_odds}))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Known(Parts):
    """Clouds whose odds are told; all lie on one whole, as far as they do."""

    together: dict

    def whole(self, row):
        return WHOLE

    def odds_together(self, row, part):
        return self.together[row, part]


def joins(clouds, odds, together, even=0.0):
    """What is joined; clouds with `odds` were found to be something."""
    partner = {row: n for n, row in enumerate(odds)}
    found = Known(compared=told(even), partner=partner, odds=odds, clouds=clouds, together=together).joins()
    return [(j.matched, j.part) for j in found]


@pytest.mark.parametrize(
    ("together", "even", "joined"),
    [(3.0, 0.0, True), (1.6, 0.0, True), (1.4, 0.0, False), (3.0, 3.5, False)],
)
def test_a_part_left_over_is_joined_where_hardly_any_odds_are_lost(together, even, joined):
    assert joins([LEFT, RIGHT], {0: 2.0}, {(0, 1): together}, even) == [(0, 1)] * joined


@pytest.mark.parametrize(("together", "joined"), [(3.9, False), (4.1, True)])
def test_what_is_likely_another_object_must_gain(together, joined):
    assert joins([LEFT, RIGHT], {0: 2.0, 1: 3.0}, {(0, 1): together, (1, 0): -9.0}) == [(0, 1)] * joined


def test_what_does_not_touch_or_does_not_lie_on_the_whole_stays_apart():
    apart = RIGHT[RIGHT[:, 0] > MIDDLE + 0.4]
    turned_up = RIGHT + [0, 0, 0.4]  # stands on the box, and touches it
    sure = {(0, 1): 9.0}
    assert joins([LEFT, apart], {0: 2.0}, sure) == []
    assert joins([SEEN, turned_up[turned_up[:, 2] > 0.21]], {0: 2.0}, sure) == []
    assert joins([LEFT, BESIDE], {0: 2.0}, sure) == []


def test_every_cloud_is_joined_once_and_the_likeliest_first():
    def join(matched, part, odds):
        return Join(matched=matched, part=part, share=1.0, odds=odds)

    best, clash, again, free = join(0, 1, 5.0), join(1, 2, 4.0), join(3, 0, 3.0), join(2, 4, 2.0)
    assert each_once([best, clash, again, free]) == [best, free]
    third = SEEN[:10]  # three parts of one: two in the first round
    clouds = [LEFT, RIGHT, third + [1e-6, 0, 0]]
    assert joins(clouds, {0: 2.0}, {(0, 1): 3.0, (0, 2): 4.0}) == [(0, 2)]


def parts_of_objects(*observed):
    """Objects that were seen in these scans, last in the frame of the scene."""
    objects = []
    for k, scans in enumerate(observed):
        seen = tuple(
            Observation(scan=s, instance=k, T_ref_scan=np.eye(4), score=1.0, rms_m=0.0, converged=True)
            for s in scans
        )
        o = new_object(k, scans[0], Instance(id=k, points=LEFT if k else RIGHT), CODE)
        objects.append(dataclasses.replace(o, observations=seen))
    clouds = [o.points for o in objects]
    return ObjectParts(compared=told(0.0), partner={}, odds={}, clouds=clouds, objects=objects)


@pytest.mark.parametrize(
    ("first", "second", "one"),
    [([0], [0], True), ([0, 1], [1], True), ([0], [0, 1], False), ([0, 1], [0], False), ([1], [0], False)],
)
def test_objects_are_parts_of_one_mask_only_if_it_saw_both_and_the_part_nothing_else(first, second, one):
    assert parts_of_objects(first, second).may_be_one(0, 1) == one


def regrouped(sizes):
    """Clouds of these sizes, one below the other, as the instances of a scan and as objects seen in one."""
    instances = [Instance(id=10 + k, points=WHOLE[:n] + [0, 0, 3.0 * k]) for k, n in enumerate(sizes)]
    objects = [new_object(k, 0, i, CODE) for k, i in enumerate(instances)]
    return Regrouped(objects=objects, instances=instances, embeddings=[CODE] * len(sizes))


JOINS = [Join(matched=0, part=2, share=0.9, odds=4.0)]


@pytest.mark.parametrize(("sizes", "kept", "gone"), [((700, 400, 300), 0, 2), ((300, 400, 700), 2, 0)])
def test_the_larger_mask_keeps_its_id_and_no_point_is_lost(tiny_prior, sizes, kept, gone):
    before = regrouped(sizes)
    after = with_instances_joined(before, JOINS, tiny_prior)
    assert sorted(i.id for i in after.instances) == sorted({10, 11, 12} - {10 + gone})
    whole = next(i for i in after.instances if i.id == 10 + kept)
    every = np.concatenate([before.instances[k].points for k in (kept, gone)])
    np.testing.assert_array_equal(whole.points, every)
    assert after.joined == (JoinedMask(instances=(10 + kept, 10 + gone), share=0.9),)
    assert len(after.embeddings) == 2 and after.embeddings[0] is not after.embeddings[1]

    halves = ((0, 1), (kept, gone))  # of masks that were divided before: the second are one again
    after = with_instances_joined(dataclasses.replace(before, halves=halves), JOINS, tiny_prior)
    (pair,) = after.halves
    assert [after.instances[i].id for i in pair] == [10 + kept, 11]

    after = with_objects_joined(before, JOINS, tiny_prior)
    assert [o.id for o in after.objects] == [o.id for k, o in enumerate(before.objects) if k != gone]
    (repair,) = after.repairs
    assert (repair.object, repair.absorbed) == (f"object_00{kept}", (f"object_00{gone}",))
    whole = next(o for o in after.objects if o.id == repair.object)
    np.testing.assert_allclose(whole.points, every, atol=1e-12)
    assert not np.array_equal(whole.embedding.inv, CODE.inv)


def test_what_was_seen_more_often_keeps_its_id_though_it_is_smaller(tiny_prior):
    before = regrouped((300, 400, 700))
    often = before.objects[0]
    again = dataclasses.replace(often.observations[0], scan=1)
    late = dataclasses.replace(before.objects[2], observations=(again,), point_scan=np.ones(700, int))
    often = dataclasses.replace(often, observations=(*often.observations, again))
    before = dataclasses.replace(before, objects=[often, before.objects[1], late])
    (repair,) = with_objects_joined(before, JOINS, tiny_prior).repairs
    assert repair.object == "object_000" and repair.absorbed == ("object_002",)
