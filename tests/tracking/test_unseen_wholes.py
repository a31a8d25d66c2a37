"""Parts of what one scan alone shows are joined where one surface goes on; what stands on another is not."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from boxes import box
from furnished import sheet
from small_scenes import CONFIG, scan

from more2_jax.scene import add_scan, start_scene
from more2_jax.tracking.unseen_wholes import smooth_joins, smooth_share
from more2_jax.types import Instance

pytestmark = pytest.mark.optimized  # scenes run for longer than their programs compile


def cut(points: np.ndarray, axis: int, share: float) -> tuple[np.ndarray, np.ndarray]:
    low = points[:, axis] < np.quantile(points[:, axis], share)
    return points[low], points[~low]


TABLE = box(0, [1.2, 0.7, 0.4], [0, 0, 0], 6000)
HALVES = cut(TABLE, 0, 0.6)
ON_IT = box(1, [0.3, 0.3, 0.3], [0.1, 0.1, 0.35], 1500)  # its underside lies on the top


def test_a_cut_is_smooth_and_a_crease_is_not():
    assert smooth_share(*HALVES) > 0.8
    standing = ON_IT[ON_IT[:, 2] > ON_IT[:, 2].min() + 0.01]  # no scan sees an underside
    assert smooth_share(standing, TABLE) < 0.3


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 1, 0], [1, 2, 0]])
def test_parts_are_joined_whatever_their_order(order):
    clouds = [HALVES[0], HALVES[1], TABLE + [3.0, 0, 0]]
    (join,) = smooth_joins([0, 1, 2], [clouds[k] for k in order])
    assert {order[join.matched], order[join.part]} == {0, 1} and join.smooth > 0.8


def test_what_does_not_touch_or_is_too_small_to_tell_stays_apart():
    assert smooth_joins([0, 1], [HALVES[0], HALVES[1] + [0.2, 0, 0]]) == []
    assert smooth_joins([0, 1], [HALVES[0][:1], HALVES[1][:1]]) == []
    assert smooth_joins([0], [TABLE]) == []
    assert smooth_joins([0, 1], HALVES, [(1, 0)]) == []  # one mask that was divided


@pytest.mark.parametrize("looked", [True, False])
def test_what_nobody_looked_for_before_stays_in_the_masks_that_it_has(tiny_prior, looked):
    """It may be two things side by side that a scan saw first."""
    halves = [Instance(id=50 + n, points=h) for n, h in enumerate(HALVES)]
    own = scan("b", {1: (0.3, 3.5)})
    visits = [
        dataclasses.replace(own, name="a", background=floor([-2.0 if looked else 2.0, -2.0, -0.6], 0)),
        dataclasses.replace(
            own, instances=(*own.instances, *halves), background=floor([-2.0, -2.0, -0.6], 1)
        ),
    ]
    made = add_scan(tiny_prior, start_scene(tiny_prior, visits[0], CONFIG), visits[1], CONFIG)
    (change,) = made.changes
    assert [len(change.added), len(change.discovered)] == ([1, 0] if looked else [0, 2])


def floor(corner: list[float], seed: int) -> np.ndarray:
    return sheet(corner, [7.0, 0, 0], [0, 5.0, 0], np.random.default_rng(seed))


@pytest.mark.parametrize("split_scan", [0, 1])
def test_what_came_or_went_in_two_masks_is_one_object(tiny_prior, split_scan):
    visits = [scan(n, {1: (0.3, 3.0)}) for n in "ab"]
    halves = [Instance(id=50 + n, points=h) for n, h in enumerate(HALVES)]
    own = visits[split_scan]
    visits[split_scan] = dataclasses.replace(own, instances=(*own.instances, *halves))
    made = add_scan(tiny_prior, start_scene(tiny_prior, visits[0], CONFIG), visits[1], CONFIG)
    (change,) = made.changes
    (told,) = (change.removed, change.added)[split_scan]
    (o,) = [o for o in made.objects if o.id == told]
    assert len(o.points) == len(TABLE)
    (repair,) = made.scans[1].repairs
    assert repair.object == told and repair.smooth > 0.8
    assert sorted(repair.instances) == ([], [50, 51])[split_scan]
    assert len(repair.absorbed) == 1 - split_scan
