"""What refinement makes of poses moves nothing that had not moved."""

import dataclasses

import numpy as np
import pytest
from factories import scene_object, turn_z

from more2_jax.config import preset
from more2_jax.tracking.changes import moved_probability, set_in_motion
from more2_jax.types import Frame

CONFIG = preset("robust", upright=True)


def seen_at(*shifts_m: float):
    """An object in as many scans, each shifted by so much from the first."""
    shifts = (0.0, *shifts_m)
    return scene_object(0, {k: turn_z(0.0, np.zeros(3), np.array([x, 0, 0])) for k, x in enumerate(shifts)})


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        ((0.0,), (0.01,), False),  # static with either
        ((0.0,), (0.2,), True),
        ((0.2,), (0.0,), False),  # what was taken to have moved may turn out not to have
        ((0.3,), (0.4,), False),
        ((0.0, 0.0), (0.01, 0.3), True),  # between any two scans
        ((0.3, 0.3), (0.4, 0.41), False),
    ],
)
def test_only_what_had_not_moved_can_be_set_in_motion(before, after, expected):
    assert set_in_motion(seen_at(*before), seen_at(*after), CONFIG) is expected


def test_an_object_that_is_as_it_was_is_not():
    o = seen_at(0.0)
    assert not set_in_motion(o, o, CONFIG)


def test_what_moved_is_in_doubt_where_nobody_knows_how_a_scan_lies():
    o = seen_at(2.0)
    before, after = o.observations
    assert moved_probability(o, before, after, CONFIG) > 0.95
    for pair in ((before, lost(after)), (lost(before), after)):
        assert 0.5 < moved_probability(o, *pair, CONFIG) < 0.6


def test_what_lies_where_it_would_as_given_has_not_moved_however_the_scan_lies():
    o = seen_at(0.0)
    before, after = o.observations
    assert moved_probability(o, before, lost(after), CONFIG) < 0.05


def lost(seen):
    """The same in a scan of unknown frame."""
    return dataclasses.replace(seen, frame=Frame(unknown=True))
