"""Clouds of a building are asked in turn: near each is all that the scan shows there, and hardly anything else."""

import numpy as np
import pytest

from more2_jax.geometry.near_points import NearClouds, NearPoints
from more2_jax.tracking.scan_nearby import TOGETHER, shown_near

RNG = np.random.default_rng(7)
MIDDLES = np.stack([*np.meshgrid(np.arange(12) * 6.0, np.arange(12) * 6.0), np.zeros((12, 12))], axis=-1)
CLOUDS = [m + RNG.normal(0, 0.5, (40, 3)) for m in MIDDLES.reshape(-1, 3)]
REST = RNG.uniform(-2, 70, (2000, 3)) * [1, 1, 0]
REACH_M = 1.5


def made(clouds):
    return [lambda c=c: c for c in clouds]


def near(cloud, points):
    """The points within reach of a cloud, as a set."""
    off = np.linalg.norm(points[:, None] - cloud[None], axis=-1).min(axis=1)
    return set(map(tuple, points[off <= REACH_M].tolist()))


@pytest.mark.parametrize(
    "places", [CLOUDS, CLOUDS[: TOGETHER + 1], CLOUDS[::-1]], ids=["all", "one more", "back"]
)
def test_each_place_is_shown_all_that_lies_within_reach(places):
    everything, count = np.concatenate([*CLOUDS, REST]), 0
    scan = NearClouds(made(CLOUDS), REST)
    for place, room in zip(places, shown_near(made(places), scan, REACH_M), strict=True):
        low, high = place.min(axis=0) - REACH_M, place.max(axis=0) + REACH_M
        assert near(place, room.around_box(low, high)) == near(place, everything)
        count += 1
    assert count == len(places)


def test_of_places_side_by_side_most_of_the_building_is_left_out():
    rooms = list(shown_near(made(CLOUDS), NearClouds(made(CLOUDS), REST), REACH_M))
    far = np.full(3, 1e3)
    sizes = {id(room): len(room.around_box(-far, far)) for room in rooms}
    assert len(sizes) == -(-len(CLOUDS) // TOGETHER)  # put in order once for those next in line
    assert max(sizes.values()) < 0.6 * len(NearPoints(np.concatenate([*CLOUDS, REST])).around_box(-far, far))


def test_of_no_places_nothing_is_shown():
    assert list(shown_near([], NearClouds(made(CLOUDS[:2]), REST), REACH_M)) == []
