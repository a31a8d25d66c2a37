"""Clouds fall apart where they are thinnest."""

import numpy as np
import pytest
from boxes import box, two_boxes
from scipy.spatial.transform import Rotation

from more2_jax.geometry.normalized_cut import best_threshold, thinnest_cuts


def agreement(side, true):
    return max((side == true).mean(), (side != true).mean())


@pytest.mark.parametrize("gap", [0.5, 1.0])
@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_what_stands_apart_is_cut_apart_at_any_size_and_turn(gap, scale):
    points, true = two_boxes(gap)
    turn = Rotation.from_euler("xyz", [1.0, 2.0, 3.0]).as_matrix()
    (side, narrow), _ = thinnest_cuts(scale * points @ turn.T + 5, 2, 0.1)
    assert narrow
    assert agreement(side, true) == 1


def test_one_solid_thing_has_no_narrow_cut():
    assert not any(narrow for _, narrow in thinnest_cuts(box(3, [1.0, 0.6, 0.7], [0, 0, 0], 900), 2, 0.1))


@pytest.mark.parametrize(
    "cloud", [np.zeros((50, 3)), np.eye(3), np.zeros((0, 3))], ids=["point", "few", "none"]
)
def test_too_little_has_no_cut(cloud):
    assert thinnest_cuts(cloud, 2, 0.1) == []


def test_the_threshold_has_the_least_normalized_cut_of_all():
    rng = np.random.default_rng(1)
    x = rng.normal(size=(30, 2))
    weights = np.exp(-((x[:, None] - x) ** 2).sum(-1))
    values = x[:, 0]
    side, least = best_threshold(values, weights, 0.1)

    def cut(side):
        across = weights[np.ix_(side, ~side)].sum()
        return across / weights[side].sum() + across / weights[~side].sum()

    every = [cut(values <= t) for t in np.sort(values)[2:-3]]  # a tenth on either side at least
    assert least == pytest.approx(min(every), rel=1e-9)
    assert cut(side) == pytest.approx(least, rel=1e-9)
