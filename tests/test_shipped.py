"""The laws of the encoder for the weights in the package."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from more2_jax.batching import pad_clouds
from more2_jax.data.demo import demo_scan_paths
from more2_jax.data.scans import read_scan
from more2_jax.prior import encode, load_prior, shipped_priors


def test_small_is_shipped():
    assert "small" in shipped_priors()


@pytest.mark.parametrize("name", shipped_priors())
def test_shipped_weights_are_equivariant(name):
    """Φ(sRX + t) = (F_inv, R F_eqv, s F_s, sR F_c + t) to 1e-4 of each part, on the demo's own scans."""
    prior, rng = load_prior(name), np.random.default_rng(0)
    clouds = [i.points[::3] for i in read_scan(demo_scan_paths()[0]).instances]
    scale = np.exp(rng.uniform(np.log(0.01), np.log(100), len(clouds)))
    turn = Rotation.random(len(clouds), random_state=0).as_matrix()
    shift = rng.uniform(-1000, 1000, (len(clouds), 3))
    moved = [s * x @ R.T + t for x, s, R, t in zip(clouds, scale, turn, shift, strict=True)]
    before, after = (jax.device_get(encode(prior, pad_clouds(c))) for c in (clouds, moved))

    def agree(found, expected, size):
        assert (np.abs(found - expected).reshape(len(clouds), -1).max(axis=1) <= 1e-4 * size).all()

    agree(after.inv, before.inv, np.abs(before.inv).max(axis=1))
    agree(after.eqv, turn @ before.eqv, np.abs(before.eqv).max(axis=(1, 2)))
    agree(after.scale, scale * before.scale, scale * before.scale)
    world = [np.asarray(e.center, np.float64) + e.origin for e in (before, after)]
    expected = scale[:, None] * np.einsum("bij,bj->bi", turn, world[0]) + shift
    agree(world[1], expected, scale * before.scale)  # relative to the object's size, not to a kilometre
