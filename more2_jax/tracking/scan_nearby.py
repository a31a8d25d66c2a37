"""What a scan shows near each of its clouds in turn: of a building, hardly more is put in order at a time."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

from more2_jax.freed_memory import give_back
from more2_jax.geometry.near_points import Made, NearClouds, NearPoints, ball_around

TOGETHER = 32  # clouds next in line, whose surroundings are put in order at once


def shown_near(places: Sequence[Made], scan: NearClouds, reach_m: float) -> Iterator[NearPoints]:
    """For every place, a cloud in the scan's frame, all that the scan shows within reach of it, and some beside."""
    for start in range(0, len(places), TOGETHER):
        give_back(len(places))
        balls = [ball_around(cloud()) for cloud in places[start : start + TOGETHER]]
        reach = max(radius for _, radius in balls) + reach_m
        yield from itertools.repeat(scan.near([center for center, _ in balls], reach), len(balls))
