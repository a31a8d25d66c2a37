"""A part that the other scan hardly shows is joined where it may have come along, and not where it stayed behind."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from more2_jax.geometry.near_points import NearClouds
from more2_jax.geometry.poses import apply_pose
from more2_jax.tracking.objects import new_object
from more2_jax.tracking.partly_shown import HARDLY_EMPTY, MOST_EMPTY, SOME_ON, coming_along, share_empty
from more2_jax.tracking.split_masks import LEAST_ON, mend_splits, share_on
from more2_jax.types import Embedding, Frame, Instance, Observation

CODE = Embedding(inv=np.ones(2), eqv=np.ones((3, 2)), scale=np.float32(1.0), center=np.zeros(3))
MOVED = np.eye(4)
MOVED[:3, :3] = Rotation.from_euler("z", 70, degrees=True).as_matrix()
MOVED[:3, 3] = [3.0, 1.0, 0.0]
CUT = 0.9  # along the bench, where its mask falls in two


def bench(seed, count=4000):
    """The seat and the back of a bench, 1.6 m long."""
    u = np.random.default_rng(seed).uniform(size=(count, 2))
    seat = np.stack([1.6 * u[:, 0], 0.5 * u[:, 1], np.full(count, 0.45)], axis=1)
    back = np.stack([1.6 * u[:, 0], np.zeros(count), 0.45 + 0.45 * u[:, 1]], axis=1)
    return np.where(np.arange(count)[:, None] % 2 == 0, seat, back)


def floor(hidden_from=None):
    """The floor about the bench; where its end is hidden, nobody saw it."""
    x, y = np.meshgrid(np.arange(-1.0, 3.0, 0.03), np.arange(-1.5, 2.0, 0.03))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    if hidden_from is None:
        return points
    x, y = points[:, 0], points[:, 1]
    return points[(x < hidden_from - 0.2) | (x > 1.8) | (y < -0.3) | (y > 0.8)]


SEEN = bench(1)
LEFT, RIGHT = SEEN[SEEN[:, 0] < CUT], SEEN[SEEN[:, 0] >= CUT]


def shown_up_to(x):
    """What the scan that hardly shows the second part has of the bench."""
    points = bench(0)
    return points[points[:, 0] < x]


def joined(other, ground, *, later, T=MOVED, part=RIGHT, frame=None, shown=True, misfit=0.3, converged=True):
    """Share of the part on the bench, where it is joined; None if it is not.

    `other`, `ground`: what one scan shows of the bench, and of the floor. The other scan shows two parts, where `T`
    has them. `later`: whether it is the later one.
    """
    here = [
        Instance(id=k + 1, points=apply_pose(T if later else np.eye(4), p))
        for k, p in enumerate((LEFT, part))
    ]
    there = Instance(id=1, points=apply_pose(np.eye(4) if later else T, other))
    rest = apply_pose(np.eye(4) if later else T, ground)
    scan = NearClouds([lambda: there.points], rest), NearClouds([], floor() + [0, 0, -9.0])
    T_ref_scan = np.linalg.inv(T)
    seen = Observation(
        scan=1,
        instance=1,
        T_ref_scan=T_ref_scan,
        score=0.9,
        rms_m=0.01,
        converged=converged,
        misfit=misfit,
        frame=frame or Frame(),
    )
    known = [there] if later else here
    objects = [new_object(n, 0, i, CODE) for n, i in enumerate(known)]
    both = (scan if later else scan[::-1]) if shown else None
    mended = mend_splits(objects, here if later else [there], [(0, 0)], [seen], both)
    assert len(mended.repairs) <= 1
    assert bool(mended.repairs) == bool(mended.instance_parts if later else mended.object_parts)
    return mended.repairs[0].share if mended.repairs else None


LATER = pytest.mark.parametrize("later", [True, False], ids=["in the later scan", "in the scan before"])


@LATER
def test_a_part_of_which_some_is_shown_comes_along_where_the_rest_is_hidden(later):
    some = shown_up_to(1.15)
    assert SOME_ON < share_on(some, RIGHT) < LEAST_ON
    assert joined(some, floor(hidden_from=1.15), later=later) == pytest.approx(
        share_on(some, RIGHT), abs=0.02
    )
    assert joined(some, floor(), later=later) is None  # it was looked for, and is not there
    assert joined(some, floor(hidden_from=1.15), later=later, shown=False) is None
    assert joined(some, floor(hidden_from=1.15), later=later, T=np.eye(4)) is not None


@LATER
def test_a_part_that_is_not_shown_at_all_comes_along_only_with_what_moved(later):
    none = shown_up_to(CUT)
    hidden = floor(hidden_from=CUT)
    assert share_on(none, RIGHT) < SOME_ON
    for misfit in (0.3, 0.8):  # of parts of which each shows what the other does not
        on = joined(none, hidden, later=later, misfit=misfit)
        assert on is not None and on < SOME_ON
    assert joined(none, floor(), later=later) is None
    assert joined(none, hidden, later=later, T=np.eye(4)) is None
    assert joined(none, hidden, later=later, frame=Frame(unknown=True)) is None
    assert joined(none, hidden, later=later, converged=False) is None


@LATER
def test_what_does_not_touch_the_object_is_none_of_it(later):
    apart = RIGHT + [0.25, 0.0, 0.0]
    assert joined(shown_up_to(1.15), floor(hidden_from=1.15)[:0], later=later, part=apart) is None


def test_empty_is_what_was_seen_past():
    scan = NearClouds([lambda: LEFT], floor())
    assert share_empty(LEFT, scan) == 0
    assert share_empty(RIGHT + [0.3, 0, 0], scan) == 1
    assert share_empty(RIGHT - [0, 0, 5.0], scan) == 0  # below all that it shows
    half = np.concatenate([LEFT, LEFT + [0, 0, 1.0]])
    assert share_empty(half, scan) == pytest.approx(0.5)


@pytest.mark.parametrize(("on", "most"), [(SOME_ON, MOST_EMPTY), (0.0, HARDLY_EMPTY)])
def test_it_is_the_surer_the_less_is_seen_to_be_empty(on, most):
    found = list[tuple[float, float | None]]()
    for edge in np.arange(CUT, 1.6, 0.05):  # the floor is seen up to there
        ground = floor()[floor()[:, 0] < edge]
        scan = NearClouds([], ground)
        sure = coming_along(on, LEFT, RIGHT, np.eye(4), MOVED, scan)
        found.append((share_empty(RIGHT, scan), sure))
    empty = [e for e, _ in found]
    assert min(empty) < 0.1 and max(empty) > 0.9 and empty == sorted(empty)
    assert all(sure == (pytest.approx(1 - e) if e <= most else None) for e, sure in found)
    assert {sure is None for _, sure in found} == {True, False}


def test_nothing_is_known_without_what_the_other_scan_shows():
    assert coming_along(1.0, LEFT, RIGHT, np.eye(4), np.eye(4), None) is None
