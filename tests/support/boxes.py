"""Clouds on the surfaces of boxes."""

import numpy as np


def box(seed, size, at, count=600):
    """Points on the surface of a box."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, size=(count, 3))
    side = rng.integers(3, size=count)
    points[np.arange(count), side] = np.where(rng.random(count) < 0.5, -0.5, 0.5)
    return points * size + at


def two_boxes(gap, seed=0):
    """A wide and a narrow box, `gap` meters from one another, in random order, and which points are the wide one's."""
    clouds = [box(seed, [1.0, 0.6, 0.7], [0, 0, 0]), box(seed + 1, [0.4, 0.5, 0.5], [0.7 + gap, 0, 0], 300)]
    order = np.random.default_rng(seed).permutation(900)
    return np.concatenate(clouds)[order], order < 600
