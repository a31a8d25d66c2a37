"""Pairs after closing: a slip is taken back, each pair as if alone."""

from __future__ import annotations

import numpy as np
import pytest
from factories import turn_z
from pieces import apply, surface, without_symmetry

from eval.harness.closed_pairs import closed_poses
from more2_jax.config import preset
from more2_jax.network.embedding_batch import embed
from more2_jax.network.prior import load_prior
from more2_jax.types import Instance, Scan

CONFIG = preset("robust", upright=True)
TRUE = turn_z(0.7, np.zeros(3), np.array([1.0, -2.0, 0.0]))  # T_target_source
SLIP = turn_z(np.deg2rad(1.0), np.zeros(3), np.array([0.004, -0.003, 0.0]))


@pytest.fixture(scope="module")
def prior():
    """The shipped one: lengths are in its canonical units."""
    return load_prior("small")


def seen_twice(k: int) -> tuple[np.ndarray, np.ndarray]:
    """Source and target, two samples of one piece."""
    piece = without_symmetry()[0]
    return apply(np.linalg.inv(TRUE), surface(piece, 3000, seed=2 * k)), surface(piece, 3000, seed=2 * k + 1)


def scan_of(cloud: np.ndarray) -> Scan:
    return Scan(name="scan", source="", instances=(Instance(id=0, points=cloud),))


def closed(prior, pairs):
    scans = [(scan_of(a), scan_of(b)) for a, b in pairs]
    codes = embed(prior, [b for _, b in pairs])
    return closed_poses(prior, pairs, scans, codes, [SLIP @ TRUE] * len(pairs), CONFIG)


@pytest.mark.slow
def test_slips_of_pairs_are_taken_back_each_as_if_alone(prior):
    pairs = [seen_twice(k) for k in range(2)]
    together = closed(prior, pairs)
    for pair, T in zip(pairs, together, strict=True):
        before = np.abs(apply(SLIP @ TRUE, pair[0]) - apply(TRUE, pair[0])).max()
        assert np.abs(apply(T, pair[0]) - apply(TRUE, pair[0])).max() < 0.1 * before
        (alone,) = closed(prior, [pair])
        np.testing.assert_allclose(T, alone, atol=1e-5)
