"""Who is who by geometry: what is assigned, what is left over and how surely, and which copies are interchangeable."""

import numpy as np
import pytest
from scipy.special import expit

from more2_jax.config import preset
from more2_jax.encoding import embed
from more2_jax.verification import (
    NEVER,
    Known,
    assign,
    fit_pairs,
    interchangeable,
    proposed,
    unmatched,
)

STILL = np.zeros((3, 3))


def box(rng, size, count=600):
    """Points on the surface of a box that stands on z = 0."""
    points = rng.uniform(-0.5, 0.5, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-0.5, 0.5], count)
    return points * size + [0, 0, size[2] / 2]


def test_only_what_is_likelier_one_than_two_is_matched():
    odds = np.array([[2.0, 1.0], [3.0, -0.5], [-1.0, -2.0]])
    assert assign(odds, np.zeros((3, 2)), 0.0).tolist() == [[0, 1], [1, 0]]
    assert assign(-np.abs(odds), np.zeros((3, 2)), 0.0).tolist() == []
    assert assign(np.full((2, 2), NEVER), np.zeros((2, 2)), 1.0).tolist() == []


def test_of_identical_copies_each_stays_as_near_as_can_be_and_is_flagged():
    odds = np.array([[3.0, 3.1, -4], [3.1, 3.0, -4], [-4, -4, 3.0]])
    moved = np.array([[0.0, 3.0, 9], [3.0, 0.0, 9], [9, 9, 0.0]])
    pairs = assign(odds, moved, 0.2)
    assert pairs.tolist() == [[0, 0], [1, 1], [2, 2]]
    assert assign(odds, moved, 0.0).tolist() == [[0, 1], [1, 0], [2, 2]]
    assert interchangeable(odds, pairs) == [True, True, False]


def test_a_copy_that_went_makes_the_other_interchangeable_and_far_motion_alone_rejects_none():
    odds = np.array([[3.0, -4], [2.9, -4]])
    pairs = assign(odds, np.array([[1.0, 5], [100.0, 5]]), 0.2)
    assert pairs.tolist() == [[0, 0]]
    assert interchangeable(odds, pairs) == [True]
    assert assign(np.array([[0.5]]), np.array([[100.0]]), 0.2).tolist() == [[0, 0]]


def test_what_is_left_over_is_gone_unless_another_left_over_may_be_it():
    odds = np.array([[2.0, -1.0, -2.0], [-3.0, -1.0, NEVER]])
    gone, new = unmatched(odds, np.array([[0, 0]]))
    assert gone == {1: pytest.approx(1 - expit(-1.0))}
    assert new == {1: pytest.approx(1 - expit(-1.0)), 2: pytest.approx(1.0)}


def test_every_row_and_column_proposes_its_best():
    score = np.random.default_rng(0).normal(size=(6, 9))
    chosen = proposed(score, 2)
    for matrix, picked in ((score, chosen), (score.T, chosen.T)):
        for row, mine in zip(matrix, picked, strict=True):
            assert mine[np.argsort(-row)[:2]].all()
    assert chosen.sum() < score.size
    assert proposed(score, 0).all()


def test_geometry_tells_boxes_of_one_size_but_different_shape_apart(tiny_prior):
    rng = np.random.default_rng(1)
    wide, tall = np.array([1.0, 0.5, 0.6]), np.array([0.5, 0.6, 1.0])  # the same box, on another face
    first = [box(rng, wide) + [5, 0, 0], box(rng, tall)]
    second = [box(rng, tall) + [2, 2, 0], box(rng, wide) + [0, 3, 0]]
    known = [
        [Known(points=p, embedding=e) for p, e in zip(clouds, embed(tiny_prior, clouds), strict=True)]
        for clouds in (first, second)
    ]
    odds = fit_pairs(known[0], known[1], preset("robust", upright=True)).odds
    assert odds.shape == (2, 2)
    assert min(odds[0, 1], odds[1, 0]) > max(odds[0, 0], odds[1, 1]) + 1
