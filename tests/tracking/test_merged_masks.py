"""Masks that hold two objects are divided where the other scan shows the halves apart; nothing else is."""

import numpy as np
import pytest
from boxes import box, two_boxes
from factories import turn_z

from more2_jax.geometry.poses import apply_pose
from more2_jax.tracking.divisions import LEAST_GAIN, Division, Part, Wholes, chosen, compatible
from more2_jax.tracking.merged_masks import Halves, Standing, beside_of, larger_first
from more2_jax.types import Embedding, ObservedObject


def agreement(side, true):
    return max((side == true).mean(), (side != true).mean())


def test_beside_a_thing_is_what_does_not_lie_on_it():
    points, true = two_boxes(0.3)
    wide = box(9, [1.0, 0.6, 0.7], [0, 0, 0], 2000)
    assert agreement(beside_of(wide, points), ~true) > 0.98
    assert beside_of(wide, points)[~true].all()


def test_the_larger_side_comes_first():
    rows = np.arange(5) < 2
    for side in (rows, ~rows):
        assert [r.sum() for r in larger_first(side)] == [3, 2]


CODE = Embedding(inv=np.ones(2), eqv=np.ones((3, 2)), scale=np.float32(1.0), center=np.zeros(3))


def pair(whole=0, narrow=False):
    sides = np.arange(10) < 7, np.arange(10) >= 7
    return tuple(Part(whole=whole, rows=s, embedding=CODE, narrow=narrow) for s in sides)


def decided(
    odds,
    *,
    partner=None,
    now=0.0,
    narrow=False,
    scale=(1.0, 1.0, 1.0),
    motion="upright",
    doubtful=(),
    both_known=False,
):
    """What becomes of one mask whose halves have `odds` (others, 2). `doubtful`: others that something hardly is."""
    odds = np.asarray(odds, float)
    partner = {} if partner is None else {0: partner}
    wholes = Wholes(
        partner=partner,
        left=[k for k in range(len(odds)) if k not in partner.values() and k not in dict(doubtful)],
        scale=scale[: len(odds)],
        odds={0: now},
        least=LEAST_GAIN[motion],
        doubtful=dict(doubtful),
        both_known=both_known,
    )
    halves = pair(narrow=narrow)

    def weigh(parts, others, among):
        assert parts == list(halves)
        assert {(others[row], part) for row, part in among} == {
            (k, part) for part, half in enumerate(halves) for k in wholes.may_be(half)
        }
        return {at: z for at, z in np.ndenumerate(odds[others]) if at in among}

    return chosen([halves], wholes, weigh)


@pytest.mark.parametrize(
    ("partner", "left", "now", "doubt"),
    [(None, 1, 0.0, False), (None, 2, 0.0, True), (0, 1, 4.0, True), (0, 1, 8.0, False), (0, 0, 0.0, False)],
)
def test_only_a_mask_whose_halves_could_be_what_is_missing_is_cut(partner, left, now, doubt):
    wholes = Wholes(
        partner={} if partner is None else {0: partner},
        left=range(1, 1 + left),
        scale=[1.0] * 3,
        odds={0: now},
        least=LEAST_GAIN["upright"],
    )
    assert wholes.in_doubt(0) == doubt


def test_halves_that_are_two_known_things_are_two():
    (d,) = decided([[3, -5], [-5, 3], [1, 1]])
    assert d.others == (0, 1)
    assert d.gain == pytest.approx(6)


@pytest.mark.parametrize(("gain", "narrow"), [(3.0, True), (4.5, False)])
def test_in_any_orientation_a_division_must_gain_more(gain, narrow):
    odds = [[gain / 2, -5], [-5, gain / 2]]
    assert decided(odds, narrow=narrow)
    assert not decided(odds, narrow=narrow, motion="free")
    assert decided(np.array(odds) * 2, narrow=narrow, motion="free")


@pytest.mark.parametrize(
    ("odds", "options"),
    [
        ([[1.5, -5], [-5, 1.5]], {}),  # too little
        ([[9, -5], [-5, -5]], {}),  # only one half is known, and they do not hang by a thread
        ([[9, 9], [-5, -5]], {}),  # both are the same one
        ([[3, -5], [-5, 3]], {"partner": 0, "now": 2.5}),  # the whole is nearly as likely
        ([[9, -5], [-5, 9]], {"scale": (0.2, 1.0)}),  # of another size
    ],
)
def test_other_masks_stay_whole(odds, options):
    assert decided(odds, **options) == []


@pytest.mark.parametrize(("held", "gain"), [(1.5, 7.5), (-2.0, 9.0), (4.9, 4.1), (5.1, None)])
def test_a_half_may_take_what_something_else_hardly_is_at_the_cost_of_that(held, gain):
    """The whole has log odds of 1 with the first, its halves of 5 each; another mask has the second."""
    found = decided([[5, -5], [-5, 5]], partner=0, now=1.0, doubtful={1: held})
    assert [d.gain for d in found] == ([] if gain is None else [pytest.approx(gain)])
    assert all(d.others == (0, 1) for d in found)


def test_nothing_is_lost_twice_with_a_mask_that_was_hardly_found():
    (d,) = decided([[5, -5], [-5, 5]], partner=0, now=1.0, doubtful={0: 1.0})
    assert d.gain == pytest.approx(9.0)


def test_half_of_what_was_found_stays_with_it_where_nothing_is_missing():
    """A thread, and a half that is the partner's: only where something is left may the other half be something else."""
    odds = [[7, -5], [-5, -5], [-5, -5]]
    assert decided(odds, partner=0, now=1.0, narrow=True)
    assert not decided(odds, partner=0, now=1.0, narrow=True, doubtful={1: 1.0, 2: 1.0})


def standing_in(points, *clouds, T=None, but=None):
    """Which of the clouds stand in the points, by their first coordinates."""
    objects = [ObservedObject(points=c, embedding=CODE) for c in clouds]
    T = np.eye(4) if T is None else T
    return [c[0, 0] for c in Standing.of(range(len(clouds)), objects, T).within(points, but)]


@pytest.mark.parametrize(("shift", "there"), [(0.0, True), (0.01, True), (0.3, False), (5.0, False)])
def test_a_thing_stands_in_a_mask_that_holds_it_where_it_was(shift, there):
    points, true = two_boxes(0.3)
    thing = box(9, [1.0, 0.6, 0.7], [0.0, 0.0, shift], 2000)
    assert standing_in(points, thing) == ([thing[0, 0]] if there else [])
    if there:
        assert agreement(beside_of(thing, points), true) > 0.95


def test_clouds_are_placed_and_the_partner_is_left_out():
    points, true = two_boxes(0.3)
    wide, narrow = points[true], points[~true]
    T = turn_z(np.deg2rad(40), np.zeros(3), np.array([3.0, -1.0, 0.2]))
    away = [apply_pose(np.linalg.inv(T), c) for c in (wide, narrow)]
    assert standing_in(points, *away) == []
    assert standing_in(points, *away, T=T) == pytest.approx([wide[0, 0], narrow[0, 0]])
    assert standing_in(points, *away, T=T, but=0) == pytest.approx([narrow[0, 0]])
    assert standing_in(points) == []


def test_half_of_a_thing_may_be_seen_from_elsewhere():
    points, true = two_boxes(0.3)
    thing = points[true]
    elsewhere = thing[:, 0] > np.quantile(thing[:, 0], 0.6)
    hidden = np.where(
        elsewhere[:, None], thing + [0.0, 9.0, 0.0], thing
    )  # four tenths that the mask does not show
    assert len(standing_in(points, hidden)) == 1
    assert standing_in(points, np.where(elsewhere[:, None], thing, thing + [0.0, 9.0, 0.0])) == []


def test_what_hangs_by_a_thread_is_divided_for_one_known_half():
    (d,) = decided([[-5, 3], [-5, -5]], narrow=True)
    assert d.others == (None, 0)


def test_no_cloud_is_divided_or_named_twice_and_the_best_come_first():
    def division(whole, others, gain):
        return Division(parts=pair(whole), others=others, gain=gain)

    best, clash, again, free = (
        division(0, (0, None), 9.0),
        division(1, (0, 3), 8.0),
        division(0, (4, 5), 7.0),
        division(2, (None, 6), 3.0),
    )
    assert compatible([free, again, clash, best]) == [best, free]


def test_once_more_in_any_orientation_both_halves_must_be_known():
    one, both = [[-5, 9], [-5, -5]], [[-5, 9], [9, -5]]
    for again in (False, True):
        assert bool(decided(one, narrow=True, motion="free", both_known=again)) is not again
        assert decided(both, narrow=True, motion="free", both_known=again)


def test_halves_are_made_when_they_are_asked_for_and_not_kept():
    made = list[int]()

    def cloud(part: Part) -> ObservedObject:
        made.append(part.whole)
        return ObservedObject(points=np.zeros((part.whole, 3)), embedding=CODE)

    parts = [Part(whole=n, rows=np.ones(n, bool), embedding=CODE, narrow=False) for n in (3, 4, 5)]
    halves = Halves(cloud, parts)
    assert len(halves) == 3 and not made
    assert len(halves[1].points) == 4 and made == [4]
    assert [len(h.points) for h in halves[1:]] == [4, 5] and made == [4, 4, 5]
    assert [len(h.points) for h in halves] == [3, 4, 5]
