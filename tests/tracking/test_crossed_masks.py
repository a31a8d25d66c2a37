"""Objects that both scans cut, each elsewhere, are joined; two things side by side stay two."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from boxes import box
from factories import turn_z
from small_scenes import CONFIG, piece, scan

from more2_jax.geometry.poses import apply_pose
from more2_jax.scene import add_scan, start_scene
from more2_jax.tracking.crossed_masks import alike, may_be_part, share_crossed
from more2_jax.tracking.objects import new_object
from more2_jax.types import Embedding, Instance, Scan

PAIRS = ((0, 0), (1, 1))
AWAY = turn_z(1.1, np.zeros(3), np.array([3.0, -2.0, 0.4]))
THERE = np.linalg.inv(AWAY)


def cut(points: np.ndarray, share: float, axis: int = 0) -> list[np.ndarray]:
    low = points[:, axis] < np.quantile(points[:, axis], share)
    return [points[low], points[~low]]


def seen(parts) -> list[np.ndarray]:
    """As a scan in another frame shows them."""
    return [apply_pose(THERE, p) for p in parts]


@pytest.fixture(scope="module")
def table():
    """Two scans of one surface."""
    return [box(seed, [1.4, 0.7, 0.5], [0, 0, 0], 3000) for seed in (0, 1)]


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_parts_that_lie_across_one_another_are_told(table, share):
    clouds = cut(table[0], 0.5), seen(cut(table[1], share))
    told = share_crossed(PAIRS, clouds, [AWAY])
    assert told is not None and told > 0.95
    assert share_crossed(PAIRS[::-1], clouds, [AWAY]) == told
    assert share_crossed(PAIRS, clouds, [np.eye(4), AWAY]) == told  # the pose at which most lies there counts


def test_parts_that_are_cut_alike_are_not(table):
    assert share_crossed(PAIRS, (cut(table[0], 0.5), seen(cut(table[1], 0.52))), [AWAY]) is None


@pytest.mark.parametrize("at", [[0.95, 0, 0], [0.1, 0.1, 0.4]])
def test_what_stands_beside_or_on_another_is_not(table, at):
    """Fusion and drift move surfaces by some centimeters, and borders with them."""
    small = [box(seed, [0.5, 0.6, 0.3], at, 900) for seed in (2, 3)]
    off = np.random.default_rng(0).normal(0, 0.015, (3000, 3))
    clouds = [table[0], small[0]], seen([table[1] + off + [0.01, 0, 0.01], small[1]])
    assert share_crossed(PAIRS, clouds, [AWAY]) is None


def test_two_motions_are_two_objects(table):
    first, second = cut(table[1], 0.7)
    clouds = cut(table[0], 0.5), [apply_pose(THERE, first), apply_pose(THERE, second + [0.9, 0, 0])]
    assert share_crossed(PAIRS, clouds, [AWAY]) is None


def objects(*observed, labels=(None, None)):
    """Objects that were seen in these scans."""
    code = Embedding(
        inv=np.ones(2), eqv=np.ones((3, 2)), scale=np.ones(()), center=np.zeros(3), origin=np.zeros(3)
    )
    made = []
    for k, scans in enumerate(observed):
        o = new_object(
            k, scans[0], Instance(id=k, points=box(k, [1, 1, 1], [0, 0, 0]), label=labels[k]), code
        )
        again = tuple(dataclasses.replace(o.observations[0], scan=s) for s in scans)
        made.append(dataclasses.replace(o, observations=again))
    return made


def test_a_part_was_seen_once_beside_the_other_and_is_called_no_other_thing():
    assert may_be_part(objects([0], [0]), 0, 1) and may_be_part(objects([0, 1], [1]), 0, 1)
    assert not may_be_part(objects([0, 1], [0]), 0, 1) and not may_be_part(objects([0], [0, 1]), 0, 1)
    assert alike(objects([0], [0], labels=("chair", None)), 0, 1)
    assert not may_be_part(objects([0], [0], labels=("chair", "lamp")), 0, 1)


def in_parts(s: Scan, share: float) -> Scan:
    """The scan whose first instance falls into two, of which the second has the id 99."""
    first, *others = s.instances
    parts = [
        dataclasses.replace(first, points=p, id=id_)
        for p, id_ in zip(cut(first.points, share), (first.id, 99), strict=True)
    ]
    return dataclasses.replace(s, instances=(*parts, *others))


@pytest.mark.optimized
@pytest.mark.parametrize("labels", [True, False])
def test_an_object_that_both_scans_cut_is_one(tiny_prior, labels):
    visits = [scan("a", {0: (0.0, 0.0), 1: (0.3, 3.0)}), scan("b", {0: (0.0, 0.4), 1: (0.3, 3.0)})]
    visits = [in_parts(v, share) for v, share in zip(visits, (0.5, 0.7), strict=True)]
    if not labels:
        bare = [[dataclasses.replace(i, label=None) for i in v.instances] for v in visits]
        visits = [dataclasses.replace(v, instances=tuple(i)) for v, i in zip(visits, bare, strict=True)]
    made = add_scan(tiny_prior, start_scene(tiny_prior, visits[0], CONFIG), visits[1], CONFIG)
    assert [[s.scan for s in o.observations] for o in made.objects] == [[0, 1]] * 2
    assert not made.changes[0].added and not made.changes[0].removed
    whole = next(o for o in made.objects if len(o.points) == 2 * len(piece(0)))
    told = {(r.instances, r.absorbed) for r in made.scans[1].repairs if r.object == whole.id}
    assert any(set(instances) == {10, 99} for instances, _ in told) and any(gone for _, gone in told)
    kept = dataclasses.replace(CONFIG, repair_masks=False)
    assert len(add_scan(tiny_prior, start_scene(tiny_prior, visits[0], kept), visits[1], kept).objects) > 2
