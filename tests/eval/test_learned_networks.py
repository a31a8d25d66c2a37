"""Learned peers, their networks: what turning, moving, padding and order may change, and what assignments sum to."""

from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eval.peers.learned import conv_onet, rpmnet, weighted_pose
from eval.peers.learned.clouds import about_vertical, centered, thinned
from eval.peers.learned.pair_features import oriented, pair_features
from eval.peers.learned.sinkhorn import NONE, sinkhorn
from eval.peers.learned.vn_dgcnn import VNDGCNN
from eval.peers.learned.vn_onet import VNONet
from more2_jax.config import EncoderConfig

assigned = jax.jit(sinkhorn, static_argnums=3)
SMALL = EncoderConfig(widths=(4, 4, 8), linear_blocks=3, neighbors=4, code=6, points=32)
RNG = np.random.default_rng(0)
CLOUD = RNG.normal(size=(32, 3)).astype(np.float32)
REAL = np.arange(32) < 24
QUERIES = RNG.normal(size=(10, 3)).astype(np.float32)


def moved(points, seed=1, scale=3.0, shift=5.0):
    R = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    return (scale * points @ R.T + shift).astype(np.float32)


def with_weights(network, *inputs):
    return partial(network.apply, jax.jit(network.init)(jax.random.key(0), *inputs))


@pytest.fixture(scope="module")
def dgcnn():
    return jax.jit(with_weights(VNDGCNN(SMALL), CLOUD, REAL))


@pytest.fixture(scope="module")
def onet_and_code():
    apply = with_weights(VNONet(SMALL), CLOUD, REAL, QUERIES)
    return jax.jit(lambda c, m, q: (apply(c, m, q), apply(c, m, method="unit_code")))


@pytest.fixture(scope="module")
def onet(onet_and_code):
    return lambda *given: onet_and_code(*given)[0]


@pytest.fixture(scope="module")
def onet_code(onet_and_code):
    return lambda *given: onet_and_code(*given, QUERIES)[1]


@pytest.fixture(scope="module")
def planes():
    return jax.jit(with_weights(conv_onet.ConvONet(), CLOUD, REAL, QUERIES))


@pytest.fixture(scope="module")
def rpm():
    apply = with_weights(rpmnet.RPMNet(), CLOUD, REAL, CLOUD, REAL)
    return jax.jit(apply, static_argnums=(4, 5))


@pytest.mark.optimized
@pytest.mark.parametrize("name", ["dgcnn", "onet_code"])
def test_the_code_of_a_cloud_does_not_change_when_it_turns_moves_and_grows(name, request):
    code = request.getfixturevalue(name)
    here, there = code(CLOUD, REAL), code(moved(CLOUD), REAL)
    np.testing.assert_allclose(there, here, atol=1e-4)
    assert np.linalg.norm(here) == pytest.approx(1, abs=1e-5)
    other = CLOUD * np.array([1, 1, 0.1], np.float32)
    assert np.abs(code(other, REAL) - here).max() > 1e-2


@pytest.mark.optimized
def test_occupancy_turns_moves_and_grows_with_the_cloud(onet):
    here, there = onet(CLOUD, REAL, QUERIES), onet(moved(CLOUD), REAL, moved(QUERIES))
    np.testing.assert_allclose(there, here, atol=1e-4)
    assert np.ptp(here) > 1e-2
    assert np.abs(onet(CLOUD, REAL, moved(QUERIES)) - here).max() > 1e-2


def test_occupancy_of_planes_moves_and_grows_with_the_cloud_but_does_not_turn(planes):
    here = planes(CLOUD, REAL, QUERIES)
    np.testing.assert_allclose(planes(3 * CLOUD + 5, REAL, 3 * QUERIES + 5), here, atol=1e-3)
    assert np.abs(planes(moved(CLOUD), REAL, moved(QUERIES)) - here).max() > 1e-3


@pytest.mark.parametrize("name", ["dgcnn", "onet", "onet_code", "planes"])
def test_padding_changes_nothing(name, request):
    network = request.getfixturevalue(name)
    rest = () if name in ("dgcnn", "onet_code") else (QUERIES,)
    nonsense = np.where(REAL[:, None], CLOUD, 1e6).astype(np.float32)
    np.testing.assert_allclose(network(nonsense, REAL, *rest), network(CLOUD, REAL, *rest), atol=1e-6)


def test_the_order_of_points_changes_no_occupancy_of_planes(planes):
    order = np.r_[np.random.default_rng(2).permutation(24), np.arange(24, 32)]
    np.testing.assert_allclose(planes(CLOUD[order], REAL, QUERIES), planes(CLOUD, REAL, QUERIES), atol=1e-5)


def test_the_order_of_points_changes_no_code(dgcnn):
    """Thinning takes farthest points, in an order of their own."""
    cloud = np.random.default_rng(3).normal(size=(90, 3))
    codes = [dgcnn(*(x[0] for x in thinned([c], 32)[:2])) for c in (cloud, cloud[::-1])]
    np.testing.assert_allclose(codes[0], codes[1], atol=1e-4)


def test_a_centered_cloud_has_mean_zero_and_radius_one():
    cloud = jax.jit(centered)(jnp.asarray(7 * CLOUD + 3), jnp.asarray(REAL))
    real = np.asarray(cloud.points)[REAL]
    np.testing.assert_allclose(real.mean(axis=0), 0, atol=1e-5)
    assert np.mean(np.sum(real**2, axis=1)) == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose(cloud.local(7 * CLOUD[REAL] + 3), real, atol=1e-5)
    assert not np.asarray(cloud.points)[~REAL].any()


def test_a_plane_that_is_linear_is_looked_up_exactly():
    middle = (np.arange(conv_onet.CELLS) + 0.5) / conv_onet.CELLS * 2 - 1
    plane = jnp.asarray(2 * middle[:, None, None] - 3 * middle[None, :, None] + 1)
    at = RNG.uniform(-0.9, 0.9, (20, 3))
    found = jax.jit(conv_onet.looked_up, static_argnums=2)(plane, jnp.asarray(at), (0, 2))[:, 0]
    np.testing.assert_allclose(found, 2 * at[:, 0] - 3 * at[:, 2] + 1, atol=1e-5)


def test_cells_hold_the_mean_of_their_points():
    points = jnp.array([[-0.99, -0.99, 0], [-0.98, -0.99, 0], [0.99, 0.99, 0], [5.0, 5.0, 0]])
    cell = jax.jit(conv_onet.cell_of, static_argnums=1)(points, (0, 1))
    last = conv_onet.CELLS**2 - 1
    assert cell.tolist() == [0, 0, last, last]
    mask = jnp.array([True, True, True, False])
    means = jax.jit(conv_onet.cell_means)(jnp.array([[1.0], [3.0], [5.0], [70.0]]), cell, mask)
    assert float(means[0, 0]) == 2 and float(means[last, 0]) == 5 and float(means.sum()) == 7


@pytest.mark.parametrize("seed", range(2))
def test_columns_of_an_assignment_sum_to_one_and_rows_in_the_end(seed):
    rng = np.random.default_rng(seed)
    rows, columns = np.arange(7) < 5, np.arange(6) < 4
    found = np.exp(assigned(jnp.asarray(rng.normal(size=(7, 6))), rows, columns, 200))
    np.testing.assert_allclose(found[:, :-1][:, columns].sum(axis=0), 1, atol=1e-5)
    np.testing.assert_allclose(found[:-1][rows].sum(axis=1), 1, atol=1e-5)
    assert found[:-1][~rows].max() == found[:, :-1][:, ~columns].max() == found[-1, -1] == 0
    early = np.exp(assigned(jnp.asarray(rng.normal(size=(7, 6))), rows, columns, 1))
    np.testing.assert_allclose(early[:, :-1][:, columns].sum(axis=0), 1, atol=1e-5)


def test_an_assignment_finds_a_permutation_and_leaves_out_who_has_no_partner():
    order = np.random.default_rng(0).permutation(6)
    scores = np.full((7, 6), -30.0)
    scores[np.arange(6), order] = 30.0  # row 6 is like none
    found = np.exp(assigned(jnp.asarray(scores), jnp.ones(7, bool), jnp.ones(6, bool), 20))
    assert found[:6, :6].argmax(axis=1).tolist() == order.tolist()
    assert found[6, -1] == pytest.approx(1, abs=1e-4) and NONE < -1e8


def test_pair_features_do_not_turn():
    R = Rotation.random(rng=np.random.default_rng(5)).as_matrix().astype(np.float32)
    whole = jnp.ones(32, bool)
    features = jax.jit(lambda points, mask: pair_features(oriented(points, mask)))
    here, there = (features(jnp.asarray(c), whole) for c in (CLOUD, CLOUD @ R.T))
    np.testing.assert_allclose(there, here, atol=2e-3)
    assert np.ptp(np.asarray(here), axis=(0, 1)).min() > 0.5


def test_normals_of_a_plane_stand_on_it_and_face_outward():
    flat = RNG.uniform(-1, 1, (64, 3)) * [1, 1, 0] + [0, 0, 0.4]
    cloud = jax.jit(oriented)(jnp.asarray(flat, jnp.float32), jnp.ones(64, bool))
    np.testing.assert_allclose(cloud.normals, np.tile([0, 0, 1], (64, 1)), atol=1e-3)


@pytest.mark.parametrize("upright", [True, False])
def test_the_pose_of_points_that_belong_together(upright):
    R = (
        about_vertical(jnp.float32(2.0))
        if upright
        else jaxlie.SO3.sample_uniform(jax.random.key(4)).as_matrix()
    )
    pose = jax.jit(weighted_pose.pose, static_argnums=3)
    T = pose(
        jnp.asarray(CLOUD), CLOUD @ R.T + jnp.array([1.0, -2, 3]), jnp.asarray(REAL, jnp.float32), upright
    )
    np.testing.assert_allclose(T[:3, :3], R, atol=1e-4)
    np.testing.assert_allclose(T[:3, 3], [1, -2, 3], atol=1e-4)
    if upright:
        tilted = pose(jnp.asarray(CLOUD), jnp.asarray(moved(CLOUD)), jnp.ones(32), True)
        np.testing.assert_allclose(tilted[2, :3], [0, 0, 1], atol=1e-6)


def test_padding_and_order_of_the_source_change_no_pose(rpm):
    here, partners = rpm(CLOUD, REAL, CLOUD[::-1].copy(), REAL[::-1].copy(), 2, False)
    order = np.r_[np.random.default_rng(2).permutation(24), np.arange(24, 32)]
    nonsense = np.where(REAL[:, None], CLOUD[order], 1e3).astype(np.float32)
    there, _ = rpm(nonsense, REAL, CLOUD[::-1].copy(), REAL[::-1].copy(), 2, False)
    np.testing.assert_allclose(there, here, atol=1e-3)
    assert here.shape == (2, 4, 4) and np.exp(partners[:, :-1, :-1]).sum() > 0


def test_a_known_partner_costs_nothing_and_a_lost_one_much():
    sure = jnp.full((33, 33), NONE).at[jnp.arange(32), jnp.arange(32)].set(0.0)
    loss = partial(rpmnet.partner_loss, CLOUD, CLOUD, jnp.asarray(REAL), jnp.ones(32, bool))
    assert float(loss(sure)) == 0 and float(loss(jnp.roll(sure, 1, axis=1))) == 20
