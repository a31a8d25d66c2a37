"""Codes of several draws: what each draw holds, and that a code is the mean of the codes of its draws."""

import dataclasses

import jax
import numpy as np
import pytest
from places import ROOT
from scipy.spatial.transform import Rotation

from more2_jax.config import load_config
from more2_jax.network.code_draws import draws
from more2_jax.network.prior import Prior, encode_one, init_prior, load_prior, sdf_one
from train.run.settings import TrainingRun

READ = 64  # points that the encoder of `tiny` reads


# One program compiles sooner than each operation by itself.
coded, distance, drawn = jax.jit(encode_one), jax.jit(sdf_one), jax.jit(draws, static_argnums=(2, 3))


def cloud(count: int, seed: int = 0) -> np.ndarray:
    return (np.random.default_rng(seed).normal(size=(count, 3)) * [1, 0.5, 0.2]).astype(np.float32)


def test_the_first_draw_is_all_and_the_others_are_different_halves():
    points, mask = cloud(1000), np.arange(1000) < 900
    found = np.asarray(drawn(points, mask, 4, READ))
    np.testing.assert_array_equal(found[0], mask)
    assert not found[:, 900:].any()
    assert (np.abs(found[1:].sum(axis=1) / 900 - 0.5) < 0.06).all()
    assert found[:, 0].all()  # where the sampling begins
    for a, b in ((1, 2), (1, 3), (2, 3)):
        assert abs((found[a] & found[b]).sum() / 900 - 0.25) < 0.06


def test_of_clouds_that_are_hardly_read_in_part_draws_hold_more():
    mask = np.arange(200) < 128
    found = np.asarray(drawn(cloud(200), mask, 4, READ))
    assert (np.abs(found[1:].sum(axis=1) / 128 - 0.75) < 0.13).all()


@pytest.mark.parametrize("count", [1, 64, 96])
def test_of_small_clouds_every_draw_is_all(count):
    mask = np.arange(200) < count
    assert (np.asarray(drawn(cloud(200), mask, 3, READ)) == np.asarray(mask)).all()


def test_draws_follow_the_points_through_motion_shuffling_and_padding():
    points, mask = np.asarray(cloud(400), np.float64), np.ones(400, bool)
    points[0] = [
        9,
        9,
        9,
    ]  # the first row, where the sampling begins, stays the first: `pad_clouds` sees to it
    with jax.enable_x64(True):
        before = np.asarray(drawn(points, mask, 3, READ))
        order = np.r_[0, 1 + np.random.default_rng(1).permutation(399)]
        moved = 7.0 * points[order] @ Rotation.random(random_state=2).as_matrix().T + [3, -2, 9]
        padded = np.concatenate([moved, np.zeros((100, 3))])
        after = np.asarray(drawn(padded, np.arange(500) < 400, 3, READ))
    np.testing.assert_array_equal(after[:, :400], before[:, order])
    assert not after[:, 400:].any()


def test_a_code_is_the_mean_of_its_draws_about_its_mean_center():
    config = dataclasses.replace(load_config(ROOT / "configs" / "tiny.yaml", TrainingRun).model, draws=4)
    prior = init_prior(config, jax.random.key(3), "tiny")
    single = Prior(params=prior.params, config=dataclasses.replace(config, draws=1))
    points, mask = cloud(300), np.ones(300, bool)
    code = coded(prior, points, mask)
    each = [coded(single, points, m) for m in np.asarray(drawn(points, mask, 4, READ))]
    assert np.abs(np.subtract(each[0].inv, each[1].inv)).max() > 1e-3 * np.abs(each[0].inv).max()
    for name in ("inv", "eqv", "scale", "center"):
        mean = np.mean([getattr(e, name) for e in each], axis=0)
        if name == "eqv":
            assert np.linalg.norm(mean) < 1 - 1e-4
            mean /= np.linalg.norm(mean)
        np.testing.assert_allclose(getattr(code, name), mean, rtol=1e-4, atol=1e-5)


def test_anchors_stay_where_they_were_in_the_cloud():
    prior = load_prior("small_2")
    single = dataclasses.replace(prior, config=dataclasses.replace(prior.config, draws=1))
    points, mask = cloud(900), np.ones(900, bool)
    a, b = (coded(p, points, mask) for p in (prior, single))
    assert np.abs(np.subtract(a.center, b.center)).max() > 1e-4
    for ours, theirs in zip(a.anchors, b.anchors, strict=True):
        at = [
            (np.asarray(x.offset) + np.asarray(e.center))[np.asarray(x.mask)]
            for x, e in ((ours, a), (theirs, b))
        ]
        np.testing.assert_allclose(at[0], at[1], atol=1e-5)
        assert (np.asarray(ours.offset)[~np.asarray(ours.mask)] == 0).all()
    assert np.isfinite(distance(prior, a, points[:50])).all()
