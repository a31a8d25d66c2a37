"""What one would match instances with instead: descriptors of size and shape, or registration of every pair."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from scipy.cluster.vq import kmeans2, vq
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from eval.peers.features import fpfh
from eval.peers.registration import all_pairs
from more2_jax.geometry.poses import Points
from more2_jax.types import Instance

Matched = dict[int, int]  # instance → instance
Matcher = Callable[[Sequence[Instance], Sequence[Instance]], Matched]

WORDS = 64  # of the bag of features
PAIRS, BINS, LONGEST_M = 20_000, 64, 4.0  # of D2


def sorted_extents(cloud: Points) -> Float[np.ndarray, "3"]:
    """Logarithm of the sorted extents along the principal axes: metric size alone."""
    centered = cloud - cloud.mean(axis=0)
    axes = np.linalg.svd(centered[:: max(1, len(centered) // 2000)], full_matrices=False)[2]
    return np.log(np.maximum(np.sort(np.ptp(centered @ axes.T, axis=0)), 1e-3))


def d2(cloud: Points) -> Float[np.ndarray, "bins"]:
    """Histogram of distances between random points, meters (Osada's D2)."""
    rng = np.random.default_rng(0)
    a, b = cloud[rng.integers(0, len(cloud), (2, PAIRS))]
    counts = np.histogram(np.linalg.norm(a - b, axis=1), BINS, (0, LONGEST_M))[0]
    return counts / counts.sum()


def by_size(one: Sequence[Instance], other: Sequence[Instance]) -> Matched:
    """Hungarian on the difference of sorted extents."""
    a, b = (np.stack([sorted_extents(i.points) for i in s]) for s in (one, other))
    return assigned(one, other, cdist(a, b))


def by_d2(one: Sequence[Instance], other: Sequence[Instance]) -> Matched:
    """Hungarian on the distance of cumulated D2 histograms (earth mover's distance)."""
    a, b = (np.stack([np.cumsum(d2(i.points)) for i in s]) for s in (one, other))
    return assigned(one, other, cdist(a, b, "cityblock"))


def by_fpfh(one: Sequence[Instance], other: Sequence[Instance]) -> Matched:
    """Hungarian on bags of FPFH words; the words are those of the two scans."""
    features = [[fpfh(i.points) for i in s] for s in (one, other)]
    words = kmeans2(np.concatenate([*features[0], *features[1]]), WORDS, minit="++", rng=0)[0]
    bags = [np.stack([bag(f, words) for f in s]) for s in features]
    return assigned(one, other, cdist(np.sqrt(bags[0]), np.sqrt(bags[1])))


def bag(feature: Float[np.ndarray, "n 33"], words: Float[np.ndarray, "w 33"]) -> Float[np.ndarray, " w"]:
    """Share of each word."""
    return np.bincount(vq(feature, words)[0], minlength=len(words)) / max(1, len(feature))


def by_registration(upright: bool, reject: float = np.inf) -> Matcher:
    """Hungarian on what is left after registering every pair by multi-start GICP; none at `reject` or above."""

    def match(one: Sequence[Instance], other: Sequence[Instance]) -> Matched:
        clouds = [[i.points for i in s] for s in (one, other)]
        return assigned(one, other, all_pairs(clouds[0], clouds[1], upright), reject)

    return match


def assigned(
    one: Sequence[Instance],
    other: Sequence[Instance],
    cost: Float[np.ndarray, "n m"],
    reject: float = np.inf,
) -> Matched:
    """The assignment with the least total cost; pairs that cost `reject` or more are none."""
    rows, columns = linear_sum_assignment(cost)
    return {one[r].id: other[c].id for r, c in zip(rows, columns, strict=True) if cost[r, c] < reject}


def matchers(upright: bool) -> dict[str, Matcher]:
    """By name."""
    return {
        "size (sorted extents)": by_size,
        "D2": by_d2,
        "FPFH bag": by_fpfh,
        "GICP of all pairs": by_registration(upright),
    }
