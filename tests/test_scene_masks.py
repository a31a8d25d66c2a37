"""Masks of two scans that are in parts, merged, dirty or cut: they are mended, which is said, or kept as given."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from furnished import sheet
from small_scenes import CONFIG, piece, scan

from more2_jax.scene import add_scan, start_scene
from more2_jax.tracking import mask_mends
from more2_jax.tracking.objects import next_number, points_of
from more2_jax.types import Scan

pytestmark = pytest.mark.optimized  # scenes run for longer than their programs compile

VISITS = (
    {0: (0.0, 0.0), 1: (0.3, 3.0)},
    {0: (0.0, 0.0), 2: (0.0, 6.0)},
    {0: (1.0, 1.0), 1: (1.2, 4.0), 2: (0.0, 6.0)},
)


def mended_and_kept(prior, visits: list[Scan]):
    """The scene of two scans with masks repaired, and with masks as they are."""
    return (
        add_scan(prior, start_scene(prior, visits[0], c), visits[1], c)
        for c in (CONFIG, dataclasses.replace(CONFIG, repair_masks=False))
    )


def in_parts(s: Scan) -> Scan:
    """The scan whose first instance falls into two, of which the smaller has the id 99."""
    first, *others = s.instances
    cut = first.points[:, 0] < np.quantile(first.points[:, 0], 0.7)
    parts = [dataclasses.replace(first, points=first.points[rows]) for rows in (cut, ~cut)]
    return dataclasses.replace(s, instances=(parts[0], *others, dataclasses.replace(parts[1], id=99)))


@pytest.mark.parametrize("split_scan", [0, 1])
def test_a_mask_in_parts_is_one_object_where_another_scan_shows_it_whole(tiny_prior, split_scan):
    visits = [scan(n, {0: (0.0, 0.0), 1: (0.3, 3.0)}) for n in "ab"]
    visits[split_scan] = in_parts(visits[split_scan])
    made, kept = mended_and_kept(tiny_prior, visits)
    assert [sorted(s.scan for s in o.observations) for o in made.objects] == [[0, 1]] * 2
    assert not made.changes[0].added and not made.changes[0].removed
    (repair,) = made.scans[1].repairs
    assert repair.object == "object_000" and repair.share > 0.9
    assert len(made.objects[0].points) == 2 * len(piece(0))
    assert (repair.instances, repair.absorbed) == (((), ("object_002",)), ((10, 99), ()))[split_scan]
    assert len(kept.objects) == 3 and not kept.scans[1].repairs
    assert len(kept.changes[0].added) + len(kept.changes[0].removed) == 1


def in_one(s: Scan) -> Scan:
    """The scan whose first two instances share one mask."""
    first, second, *others = s.instances
    both = dataclasses.replace(first, points=np.concatenate([first.points, second.points]))
    return dataclasses.replace(s, instances=(both, *others))


@pytest.mark.parametrize("merged_scan", [0, 1])
def test_a_mask_that_holds_two_objects_is_divided_where_another_scan_shows_them_apart(
    tiny_prior, merged_scan
):
    visits = [scan(n, {0: (0.0, 0.0), 1: (0.3, 3.0), 2: (0.1, -3.0)}) for n in "ab"]
    visits[merged_scan] = in_one(visits[merged_scan])
    made, kept = mended_and_kept(tiny_prior, visits)
    assert [sorted(s.scan for s in o.observations) for o in made.objects] == [[0, 1]] * 3
    assert not made.changes[0].added and not made.changes[0].removed
    (repair,) = made.scans[1].repairs
    assert repair.divided is not None and len(repair.instances) == merged_scan
    masks = [o.observations[merged_scan].instance for o in made.objects]
    assert sorted(masks.count(m) for m in set(masks)) == [1, 2]
    assert sum(len(o.points) for o in made.objects) == sum(len(i.points) for v in visits for i in v.instances)
    assert made.scans[merged_scan].instances == tuple(i.id for i in visits[merged_scan].instances)
    assert kept.changes[0].added or kept.changes[0].removed


@pytest.mark.parametrize(("merged", "expected"), [(True, [True, False]), (False, [False])])
def test_masks_are_looked_at_again_where_one_was_divided(tiny_prior, monkeypatch, merged, expected):
    """Its halves may show that a mask of the other scan holds two things as well."""
    found = []

    def noted(masks, compared, first_number, divide=mask_mends.divide_merged):
        divided = divide(masks, compared, first_number)
        found.append(divided is not None)
        assert first_number == next_number(masks.objects, ())
        return divided

    monkeypatch.setattr(mask_mends, "divide_merged", noted)
    visits = [scan(n, {0: (0.0, 0.0), 1: (0.3, 3.0), 2: (0.1, -3.0)}) for n in "ab"]
    first = in_one(visits[0]) if merged else visits[0]
    add_scan(tiny_prior, start_scene(tiny_prior, first, CONFIG), visits[1], CONFIG)
    assert found == expected


def furnished(name: str, seed: int) -> Scan:
    """Two pieces a little over a floor: their undersides are seen, and no part of it."""
    floor = sheet([-1.2, -1.2, -0.31], [5.0, 0, 0], [0, 2.4, 0], np.random.default_rng(seed))
    return dataclasses.replace(scan(name, {0: (0.0, 0.0), 1: (0.3, 3.0)}), background=floor)


def with_mask(s: Scan, points: np.ndarray, background: np.ndarray) -> Scan:
    """The scan with another mask of its first instance."""
    first, *others = s.instances
    instances = (dataclasses.replace(first, points=points), *others)
    return dataclasses.replace(s, instances=instances, background=background)


@pytest.mark.parametrize("dirty_scan", [0, 1])
def test_floor_in_a_mask_is_left_out_and_said_to_be(tiny_prior, dirty_scan):
    visits = [furnished("a", 0), furnished("b", 4)]
    dirty, own = visits[dirty_scan], visits[dirty_scan].instances[0].points
    beside = (np.abs(dirty.background - [0.5, 0.3, -0.31]) < [0.2, 0.2, 0.03]).all(axis=1)
    both = np.concatenate([own, dirty.background[beside]])
    visits[dirty_scan] = with_mask(dirty, both, dirty.background[~beside])
    made, kept = mended_and_kept(tiny_prior, visits)
    left = points_of(made.objects[0], made.objects[0].observations[dirty_scan])
    (repair,) = made.scans[dirty_scan].repairs
    assert (repair.object, repair.instances, repair.points) == ("object_000", (10,), len(both))
    assert repair.dropped == len(both) - len(left) > 0.9 * beside.sum() > 40
    assert set(map(bytes, np.round(own, 6))) <= set(map(bytes, np.round(left, 6)))
    assert not made.scans[1 - dirty_scan].repairs
    assert len(points_of(kept.objects[0], kept.objects[0].observations[dirty_scan])) == len(both)
    assert not any(s.repairs for s in kept.scans)


@pytest.mark.parametrize("cut_scan", [0, 1])
def test_what_was_cut_off_a_mask_comes_back_from_the_background(tiny_prior, cut_scan):
    visits = [furnished("a", 0), furnished("b", 4)]
    whole = visits[cut_scan].instances[0].points
    lost = whole[:, 0] > 0.1
    background = np.concatenate([visits[cut_scan].background, whole[lost]])
    visits[cut_scan] = with_mask(visits[cut_scan], whole[~lost], background)
    made, kept = mended_and_kept(tiny_prior, visits)
    (repair,) = made.scans[1].repairs
    assert repair.object == "object_000" and repair.regained > 0.9 * lost.sum() > 100
    assert repair.instances == ((), (10,))[cut_scan]
    counts = [
        [len(points_of(s.objects[0], seen)) for seen in s.objects[0].observations] for s in (made, kept)
    ]
    assert counts[0][cut_scan] == counts[1][cut_scan] + repair.regained == (~lost).sum() + repair.regained
    assert counts[0][1 - cut_scan] == counts[1][1 - cut_scan] == len(whole)
    assert not any(s.repairs for s in kept.scans)
