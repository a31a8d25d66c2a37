"""GeoTransformer's parts: what turning and padding may change, patches and their overlap, one pose of many."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_scenes import pose

from eval.peers.learned import geotransformer as geo
from eval.peers.learned import local_to_global as fine
from eval.peers.learned import patches
from eval.peers.learned.clouds import thinned
from eval.peers.learned.geometric_attention import WIDTH, Attention, Geometry
from eval.peers.learned.patches import MEMBERS, SUPERPOINTS
from eval.peers.learned.training_pairs import turned_pair

local_to_global, mutual = jax.jit(fine.local_to_global, static_argnums=3), jax.jit(fine.mutual)
patches_of, overlap = jax.jit(patches.patches_of), jax.jit(patches.overlap)
true_partners = jax.jit(geo.true_partners)
RNG = np.random.default_rng(0)
CLOUD, REAL = (np.asarray(x[0]) for x in thinned([RNG.normal(size=(300, 3))], 64)[:2])
REAL = REAL & (np.arange(64) < 50)
TURN = pose(70, [0, 0, 0])[:3, :3].astype(np.float32)


@pytest.fixture(scope="module")
def network():
    made = geo.GeoTransformer()
    params = jax.jit(made.init)(jax.random.key(0), CLOUD, REAL, CLOUD, REAL)
    return jax.jit(partial(made.apply, params))


@pytest.mark.slow
@pytest.mark.optimized
def test_turning_about_the_vertical_changes_no_feature_and_tilting_does(network):
    here, other = network(CLOUD, REAL, CLOUD, REAL)
    turned, still = network(CLOUD @ TURN.T, REAL, CLOUD, REAL)
    tilted, _ = network(CLOUD[:, [0, 2, 1]], REAL, CLOUD, REAL)
    for name in ("dense", "coarse"):
        rows = REAL[: len(getattr(here, name))]
        np.testing.assert_allclose(getattr(turned, name)[rows], getattr(here, name)[rows], atol=5e-3)
        np.testing.assert_allclose(getattr(still, name)[rows], getattr(other, name)[rows], atol=5e-3)
        assert np.abs(getattr(tilted, name) - getattr(here, name))[rows].max() > 0.05
    np.testing.assert_allclose(np.linalg.norm(here.coarse, axis=1), 1, atol=1e-4)


def test_padding_changes_no_feature(network):
    nonsense = np.where(REAL[:, None], CLOUD, 50.0).astype(np.float32)
    here, there = (network(c, REAL, CLOUD, REAL)[0] for c in (CLOUD, nonsense))
    np.testing.assert_allclose(there.dense[REAL], here.dense[REAL], atol=1e-4)
    np.testing.assert_allclose(there.coarse, here.coarse, atol=1e-4)


def test_attention_asks_only_what_is_real_and_sees_how_it_lies():
    x, points = (jnp.asarray(RNG.normal(size=(6, n)), jnp.float32) for n in (WIDTH, 3))
    real = jnp.arange(6) < 5
    lies = Geometry()
    g = jax.jit(lambda key: lies.init_with_output(key, points, real)[0])(jax.random.key(1))
    one = Attention()
    params = jax.jit(one.init)(jax.random.key(0), x, x, real, g)
    asked = jax.jit(partial(one.apply, params))
    np.testing.assert_allclose(
        asked(x, jnp.where(real[:, None], x, 9.0), real, g), asked(x, x, real, g), atol=1e-5
    )
    assert np.abs(asked(x, x, real, g) - asked(x, x, real, jnp.roll(g, 1, axis=1))).max() > 1e-2
    assert np.abs(asked(x, x, real) - asked(x, x, real, g)).max() > 1e-2


def test_points_belong_to_the_nearest_superpoint():
    found = patches_of(jnp.asarray(CLOUD), jnp.asarray(REAL))
    apart = np.linalg.norm(CLOUD[REAL][:, None] - CLOUD[:SUPERPOINTS], axis=-1)
    np.testing.assert_array_equal(found.owner[REAL], apart.argmin(axis=1))
    held = np.asarray(found.members)[np.asarray(found.real)]
    assert len(held) == len(set(held)) and REAL[held].all()
    most = np.bincount(found.owner[REAL], minlength=SUPERPOINTS)
    assert len(held) == np.minimum(most, MEMBERS).sum() and most.min() >= 1


def test_a_cloud_overlaps_itself_patch_by_patch():
    one = patches_of(jnp.asarray(CLOUD), jnp.asarray(REAL))
    partner = jnp.asarray(np.diag(REAL))
    np.testing.assert_allclose(overlap(partner, one, one), np.eye(SUPERPOINTS), atol=1e-6)
    assert not overlap(jnp.zeros((64, 64), bool), one, one).any()
    half = overlap(partner & (one.owner == 0), one, one)
    np.testing.assert_allclose(half, np.diag(np.eye(SUPERPOINTS)[0]), atol=1e-6)


def test_a_turned_pair_lies_where_it_belongs():
    made = turned_pair(jnp.stack([CLOUD, CLOUD + 1]), jnp.stack([REAL, REAL]), jnp.float32(np.deg2rad(70)))
    np.testing.assert_allclose(made.source[REAL], made.target[REAL] @ TURN.T, atol=1e-5)
    radius = np.sqrt(np.mean(np.sum((CLOUD[REAL] - CLOUD[REAL].mean(axis=0)) ** 2, axis=1)))
    np.testing.assert_allclose(made.there[REAL] - made.target[REAL], -np.ones((50, 3)) / radius, atol=1e-5)


@pytest.mark.parametrize("upright", [True, False])
def test_the_pose_most_partners_agree_with(upright):
    T = pose(130, [0.3, -0.2, 0.1])
    a = RNG.normal(size=(8, 6, 3))
    b = a @ T[:3, :3].T + T[:3, 3]
    b[5:] = RNG.normal(size=(3, 6, 3))  # three pairs of patches that are none
    weight = np.tile(np.eye(6), (8, 1, 1)).astype(np.float32)
    found = local_to_global(jnp.asarray(a), jnp.asarray(b), jnp.asarray(weight), upright)
    np.testing.assert_allclose(found, T, atol=1e-3)


def test_partners_must_be_among_the_best_of_both():
    scores = jnp.asarray(RNG.uniform(0.1, 1, (2, 8, 8)))
    kept = np.asarray(mutual(scores))
    for k in range(2):
        rank = [np.argsort(np.argsort(-scores[k], axis=axis), axis=axis) for axis in (0, 1)]
        np.testing.assert_array_equal(kept[k] > 0, (rank[0] < 3) & (rank[1] < 3))
    assert not mutual(scores / 100).any()


def test_true_partners_and_who_has_none():
    one = patches_of(jnp.asarray(CLOUD), jnp.asarray(REAL))
    size = int((one.owner == 2)[REAL].sum())
    own = true_partners(jnp.asarray(np.diag(REAL)), one, one, jnp.array([2, 2]))
    wanted = np.diag((np.arange(MEMBERS + 1) < size).astype(np.float32))
    np.testing.assert_array_equal(own, wanted)
    other = true_partners(jnp.asarray(np.diag(REAL)), one, one, jnp.array([2, 3]))
    assert not other[:-1, :-1].any() and other[:-1, -1].sum() == size
    assert other[-1, :-1].sum() == (one.owner == 3)[REAL].sum()


def test_superpoints_that_overlap_cost_nothing_when_they_are_alike():
    shared = np.eye(4) * [0.5, 1, 0.2, 0]  # the last has no partner, and is not asked
    sure = 60.0 * np.eye(4)
    loss = geo.coarse_loss(jnp.asarray(sure), jnp.asarray(shared))
    assert float(loss) == pytest.approx(0, abs=1e-5)
    wrong = geo.coarse_loss(jnp.asarray(np.roll(sure, 1, axis=1)), jnp.asarray(shared))
    assert float(wrong) == pytest.approx(60, rel=1e-3)


def test_the_likeliest_pairs_are_alike_for_both():
    scores = jnp.asarray(RNG.normal(size=(5, 7)))
    pairs = np.asarray(geo.likeliest(scores, 3))
    np.testing.assert_allclose(
        [scores[i, j] for i, j in pairs], np.sort(np.asarray(scores).ravel())[::-1][:3]
    )
