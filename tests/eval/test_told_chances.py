"""Whether what is told is as sure as it is said to be, by hand."""

import dataclasses

import numpy as np
import pytest
from known_scenes import known_scene

from eval.scores.figures import rows_of
from eval.scores.reliability import calibration_error, error_by_chance
from eval.scores.told_chances import (
    CHANGES,
    FIGURES,
    MATCHES,
    MOTIONS,
    changes_told,
    matches_told,
    motions_told,
    told_chances,
)
from eval.scores.tracks import Track

SCENE = known_scene(copies=("a", "b", "b", "c"), scans=2)
POINTS = np.zeros((4, 3))


def track(first=None, second=None, **more):
    instance = {k: i for k, i in enumerate((first, second)) if i is not None}
    return Track(instance=instance, T_track_scan={k: np.eye(4) for k in instance}, points=POINTS, **more)


def told(records, figure):
    return [(r[figure.key], r[figure.over]) for r in records]


@pytest.mark.parametrize(
    ("first", "second", "so"),
    [
        (0, 10, [1.0]),
        (1, 12, [1.0]),  # a copy
        (0, 11, [0.0]),
        (0, 99, [0.0]),  # nothing known is there
        (99, 10, [0.0]),
        (99, 98, []),  # of two such masks nobody knows
    ],
)
def test_a_match_is_right_if_both_masks_show_one_shape(first, second, so):
    found = matches_told(SCENE, [track(first, second, matched={1: 0.8})])
    assert told(found, MATCHES) == [(0.8, x) for x in so]


def test_what_is_not_told_as_probable_does_not_count():
    assert told_chances(SCENE, [track(0, 10), track(1), track(None, 11)]) == []


def gone(visible):
    """The first object is in the first scan alone, or in both and seen in one."""
    o = SCENE.objects[0]
    poses = o.T_scan_model if visible else {0: o.T_scan_model[0]}
    first = dataclasses.replace(o, instance={0: 0}, T_scan_model=poses)
    return dataclasses.replace(SCENE, objects=(first, *SCENE.objects[1:]))


def test_a_change_is_right_if_the_object_came_or_went_whoever_could_know_it():
    tracks = [track(0, alone={1: 0.9}), track(1, alone={1: 0.6}), track(None, 11, alone={1: 0.4})]
    assert told(changes_told(gone(visible=False), tracks), CHANGES) == [(0.4, 0.0), (0.9, 1.0), (0.6, 0.0)]
    assert told(changes_told(gone(visible=True), tracks), CHANGES) == [(0.4, 0.0), (0.9, 0.0), (0.6, 0.0)]
    nothing = [track(77, alone={1: 0.9})]  # a mask of no object
    assert told(changes_told(gone(visible=False), nothing), CHANGES) == []
    silent = dataclasses.replace(tracks[0], not_seen=frozenset({1}))  # says that nobody looked
    assert told(changes_told(gone(visible=False), [silent]), CHANGES) == []


def test_the_figure_is_the_gap_between_what_is_said_and_what_is_so():
    said = [track(0, 10, matched={1: 0.95}), track(1, 11, matched={1: 0.95}), track(3, 12, matched={1: 0.45})]
    records = [{"method": "ours", **r} for r in told_chances(SCENE, said)]
    (row,) = rows_of([MATCHES], {"room": records})
    # Two at 0.95, both right, and one at 0.45 that is wrong.
    assert row.value == pytest.approx(100 * (2 * 0.05 + 0.45) / 3) and row.count == 3
    certain = [{"method": "ours", MATCHES.key: 1.0, MATCHES.over: 1.0}] * 2
    (row,) = rows_of([MATCHES], {"room": certain, "other": certain})
    assert row.value == pytest.approx(0.0) and row.ci95 == pytest.approx((0.0, 0.0))
    assert rows_of([CHANGES], {"room": records}) == []
    means = {r.name: r.value for r in rows_of(FIGURES, {"room": records})}
    assert means["told probability of matches"] == pytest.approx(100 * (2 * 0.95 + 0.45) / 3)
    assert means["true share of matches"] == pytest.approx(100 * 2 / 3)


def moving(moved):
    """The first object is known to have moved, or not; None: nobody knows."""
    o = dataclasses.replace(SCENE.objects[0], moved={} if moved is None else {1: moved})
    return dataclasses.replace(SCENE, objects=(o, *SCENE.objects[1:]))


@pytest.mark.parametrize(
    ("second", "moved", "so"),
    [
        (10, True, [1.0]),
        (10, False, [0.0]),
        (10, None, []),
        (11, True, []),  # of another object nobody asks
    ],
)
def test_a_motion_is_asked_of_right_matches_alone(second, moved, so):
    said = [track(0, second, moved={1: True}, motion={1: 0.7})]
    assert told(motions_told(moving(moved), said), MOTIONS) == [(0.7, x) for x in so]
    assert motions_told(moving(moved), [track(0, second, moved={1: True})]) == []


def test_few_true_probabilities_have_an_error_by_chance_that_many_have_not():
    rng = np.random.default_rng(1)
    few, many = rng.normal(0, 2, 40), rng.normal(0, 2, 20_000)
    assert error_by_chance(few) > 0.05 > 0.02 > error_by_chance(many)
    sure = np.full(50, 40.0)
    assert error_by_chance(sure) == pytest.approx(0.0, abs=1e-9)
    so = rng.random(len(many)) < 1 / (1 + np.exp(-many))
    assert abs(calibration_error(many, so) - error_by_chance(many)) < 0.01
