"""What a scan shows without a mask is found where it is missing, and nothing else is."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from factories import embedding
from furnished import sheet
from small_scenes import CONFIG, piece, scan

from more2_jax.config import preset
from more2_jax.scene import add_scan, start_scene
from more2_jax.tracking import unmasked
from more2_jax.tracking.comparison import Comparison
from more2_jax.tracking.objects import points_of
from more2_jax.tracking.room_points import remembered
from more2_jax.tracking.unmasked import REST, SMALL, TURNED, Thing, explained, things
from more2_jax.types import ObservedObject, Scan

pytestmark = pytest.mark.optimized  # scenes run for longer than their programs compile


def room(name: str, places: dict[int, tuple[float, float]], seed: int) -> Scan:
    """Pieces a little over a floor."""
    floor = sheet([-2.0, -2.0, -0.6], [7.0, 0, 0], [0, 5.0, 0], np.random.default_rng(seed))
    return dataclasses.replace(scan(name, places), background=floor)


def overlooked(s: Scan, row: int) -> Scan:
    """The scan without the mask of one instance, whose points lie in the background."""
    lost = s.instances[row]
    return dataclasses.replace(
        s,
        instances=tuple(i for i in s.instances if i is not lost),
        background=np.concatenate([s.background, lost.points]),
    )


HERE, THERE = (0.0, 0.0), (1.2, 1.0)  # angle, x


@pytest.mark.parametrize("unmasked_scan", [0, 1])
def test_what_moved_and_has_no_mask_in_one_scan_is_found(tiny_prior, unmasked_scan):
    visits = [room("a", {0: HERE, 1: (0.3, 3.5)}, 0), room("b", {0: THERE, 1: (0.3, 3.5)}, 4)]
    whole = set(map(bytes, np.round(visits[unmasked_scan].instances[0].points, 6)))
    visits[unmasked_scan] = overlooked(visits[unmasked_scan], 0)
    background = visits[unmasked_scan].background
    background = background if unmasked_scan else remembered(background)  # what is known of scans before
    made = add_scan(tiny_prior, start_scene(tiny_prior, visits[0], CONFIG), visits[1], CONFIG)
    (change,) = made.changes
    assert not (change.added or change.removed or change.not_seen or change.discovered)
    (moved,) = change.moved
    (o,) = [o for o in made.objects if o.id == moved]
    seen = next(s for s in o.observations if s.scan == unmasked_scan)
    assert seen.instance not in [i.id for i in visits[unmasked_scan].instances]
    found, known = (set(map(bytes, np.round(p, 6))) for p in (points_of(o, seen), background))
    assert found <= whole & known
    assert len(found) > 0.9 * len(whole & known)
    (repair,) = made.scans[1].repairs
    assert (repair.object, repair.unmasked) == (moved, len(found))
    assert repair.instances == ((), (seen.instance,))[unmasked_scan]


@pytest.mark.parametrize("scan_with_clutter", [0, 1])
def test_something_else_without_a_mask_stays_background(tiny_prior, scan_with_clutter):
    visits = [room("a", {1: (0.3, 3.5)}, 0), room("b", {1: (0.3, 3.5)}, 4)]
    other = 1 - scan_with_clutter
    visits[other] = room("ab"[other], {0: HERE, 1: (0.3, 3.5)}, 4 * other)
    ball = np.random.default_rng(1).normal(size=(600, 3))
    clutter = 0.15 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + [1.0, 0.3, -0.4]
    background = np.concatenate([visits[scan_with_clutter].background, clutter])
    visits[scan_with_clutter] = dataclasses.replace(visits[scan_with_clutter], background=background)
    made = add_scan(tiny_prior, start_scene(tiny_prior, visits[0], CONFIG), visits[1], CONFIG)
    (change,) = made.changes
    assert len((change.removed, change.added)[scan_with_clutter == 0]) == 1
    assert not change.moved and not made.scans[1].repairs


@pytest.mark.slow
def test_masks_are_kept_where_that_is_asked(tiny_prior):
    kept = dataclasses.replace(CONFIG, repair_masks=False)
    visits = room("a", {0: HERE, 1: (0.3, 3.5)}, 0), overlooked(room("b", {0: THERE, 1: (0.3, 3.5)}, 4), 0)
    made = add_scan(tiny_prior, start_scene(tiny_prior, visits[0], kept), visits[1], kept)
    assert len(made.changes[0].removed) == 1 and not made.scans[1].repairs


def test_what_is_found_in_a_later_scan_did_not_come_with_it(tiny_prior):
    """Nobody sought it in the scans before: they do not tell that it was not there."""
    first, second, third = (
        room("a", {1: (0.3, 3.5)}, 0),
        overlooked(room("b", {0: HERE, 1: (0.3, 3.5)}, 4), 0),
        room("c", {0: THERE, 1: (0.3, 3.5)}, 9),
    )
    made = start_scene(tiny_prior, first, CONFIG)
    for s in (second, third):
        made = add_scan(tiny_prior, made, s, CONFIG)
    (o,) = [o for o in made.objects if o.id in made.changes[-1].moved]
    assert [s.scan for s in o.observations] == [1, 2]
    assert o.id in made.scans[0].not_seen


def test_things_are_neither_floor_nor_what_lies_beside_a_mask():
    s = overlooked(room("a", {0: HERE, 1: (0.3, 3.5)}, 0), 0)
    (thing,) = things(s.background, [i.points for i in s.instances])
    assert thing.points[:, 2].min() > -0.55 and not thing.rest
    left = np.concatenate([s.background, s.instances[0].points + [0, 0, 0.02]])
    assert len(things(left, [i.points for i in s.instances])) == 1
    assert things(s.background[:100], []) == []
    assert (
        things(np.concatenate([s.background, [[1e6, 0, 0]]]), []) == []
    )  # wider than its voxels can be numbered
    assert things(s.background, np.array_split(s.background, 20)) == []  # all of it is in masks


def test_of_a_large_background_some_points_are_looked_at(monkeypatch):
    s = overlooked(room("a", {0: HERE, 1: (0.3, 3.5)}, 0), 0)
    whole, masks = len(piece(0)), [i.points for i in s.instances]
    assert sum(len(t.points) for t in things(s.background, masks)) > 0.9 * whole
    monkeypatch.setattr(unmasked, "MOST_POINTS", len(s.background) - 1)
    assert 0.3 * whole < sum(len(t.points) for t in things(s.background, masks)) <= 0.5 * whole


def comparison(upright: bool) -> Comparison:
    """One of nothing, which knows its settings."""
    config, compared = preset("robust", upright=upright), object.__new__(Comparison)
    for name, value in {"config": config, "matcher": config.matching, "prior": None}.items():
        object.__setattr__(compared, name, value)
    return compared


@pytest.mark.parametrize(
    ("upright", "size_m", "rest", "asked"),
    [
        (True, 2.0, False, 0.0),
        (False, 2.0, False, TURNED),
        (False, 2.0, True, TURNED + REST),
        (True, 0.2, False, SMALL),
    ],
)
def test_more_is_asked_in_any_orientation_of_rests_and_of_small_things(
    monkeypatch, upright, size_m, rest, asked
):
    compared = comparison(upright)
    cube = size_m * np.random.default_rng(0).uniform(size=(300, 3))
    cloud = ObservedObject(points=cube, embedding=embedding(np.random.default_rng(1), np.zeros(3)))
    monkeypatch.setattr(unmasked, "parts_like", lambda *_, **__: [Thing(points=cube, rest=rest)])
    monkeypatch.setattr(unmasked, "observed", lambda *_: [cloud])
    for more, found in ((-0.05, 0), (0.05, 1)):
        odds = {(0, 0): compared.even_odds + asked + more}
        monkeypatch.setattr(unmasked, "odds_with", lambda *_, odds=odds: odds)
        assert len(explained(compared, [cloud], [], instances=True)) == found
