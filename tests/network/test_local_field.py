"""The look-up around a query is the sum it says it is, moves with the object, and pads without a trace."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from places import ROOT
from scipy.spatial.transform import Rotation

from more2_jax.config import load_config, preset
from more2_jax.geometry.transform import rescale, transform
from more2_jax.network.local_field import (
    LEAST_SHARE,
    MIN_VARIANCE,
    NORMAL_FEATURES,
    PLANE_REACH,
    LocalLookup,
    local_width,
    plane_features,
    plane_offsets,
    plane_rows,
)
from more2_jax.network.prior import encode_one, init_prior, sdf_one
from more2_jax.scene import start_scene
from more2_jax.types import Anchors, Instance, Scan
from train.run.settings import TrainingRun

CHANNELS, BANDWIDTHS, INPUTS = 4, (0.1, 0.3), 6
# Compiled: one by one, their operations would take longer.
encoded, distance = jax.jit(encode_one), jax.jit(sdf_one)
offsets, placed_by = jax.jit(plane_offsets), jax.jit(lambda e, T, scale: transform(rescale(e, scale), T))
moved_by = jax.jit(lambda T, points: jax.vmap(lambda p: T @ (2.5 * p))(points))
turned_by = jax.jit(lambda T, rows: jax.vmap(lambda n: T.rotation() @ n)(rows))


@partial(jax.jit, static_argnames=("count", "seed"))
def random_anchors(count: int, seed: int = 0) -> Anchors:
    k_offset, k_features = jax.random.split(jax.random.key(seed))
    features = jax.random.normal(k_features, (count, 3, INPUTS))
    return Anchors(
        offset=0.4 * jax.random.normal(k_offset, (count, 3)),
        features=features / jnp.linalg.norm(features, axis=(-2, -1), keepdims=True),
        mask=jnp.ones(count, bool),
    )


@pytest.fixture(scope="module")
def lookup():
    module = LocalLookup(CHANNELS, BANDWIDTHS, INPUTS)
    params = jax.jit(lambda *given: module.init(*given, method="tabulate"))(
        jax.random.key(1), random_anchors(5), jnp.float32(1.0)
    )

    @jax.jit
    def asked(params, anchors: Anchors, scale: jax.Array, q: jax.Array) -> jax.Array:
        bound = module.bind(params)
        return bound.query(bound.tabulate(anchors, scale), q)[0]

    def ask(anchors: Anchors, scale: float, q: np.ndarray) -> np.ndarray:
        return np.asarray(asked(params, anchors, jnp.float32(scale), jnp.asarray(q, jnp.float32)))

    return params["params"], ask


def one_by_one(params, anchors: Anchors, scale: float, q: np.ndarray) -> np.ndarray:
    """Every query and every anchor in a loop, offsets taken by subtraction, float64."""
    slope, left, right = (np.asarray(params[k], np.float64) for k in ("slope", "left", "right"))
    real = np.flatnonzero(anchors.mask)
    positions = np.asarray(anchors.offset, np.float64)[real] / scale
    features = np.asarray(anchors.features, np.float64)[real] * np.sqrt(INPUTS)
    rows = []
    for p in q:
        row = []
        for h, bandwidth in enumerate(np.exp(np.asarray(params["log_bandwidth"], np.float64))):
            columns = slice(h * CHANNELS, (h + 1) * CHANNELS)
            exponent = np.array([-((p - x) @ (p - x)) / (2 * bandwidth**2) for x in positions])
            w = np.exp(exponent - exponent.max())  # the largest is 1: far away all would underflow
            w /= w.sum()
            slopes = [f @ slope[:, columns] for f in features]
            constants = [((f @ left[:, columns]) * (f @ right[:, columns])).sum(axis=0) / 3 for f in features]
            linear = sum(k * ((p - x) @ b) for k, x, b in zip(w, positions, slopes, strict=True))
            constant = sum(k * c for k, c in zip(w, constants, strict=True))
            mean = w @ positions
            covariance = np.einsum("a,ai,aj->ij", w, positions - mean, positions - mean)
            spread = max(np.trace(covariance), MIN_VARIANCE)
            across = p - mean - 2 * covariance @ (p - mean) / spread
            distance = np.sqrt((p - mean) @ (p - mean) + spread)
            height = np.linalg.norm(across)
            blended = sum(k * b for k, b in zip(w, slopes, strict=True))
            row += [
                *(linear / (distance + bandwidth) + constant),
                distance,
                distance / (distance + bandwidth),
            ]
            row += [*(across @ blended / (height + 0.02)), height, height / (height + 0.02), np.sqrt(spread)]
        rows.append(row)
    return np.array(rows)


def test_blend_is_the_normalized_sum_over_anchors(lookup):
    params, ask = lookup
    q = np.random.default_rng(0).uniform(-0.6, 0.6, (20, 3))
    anchors = random_anchors(30)
    got = ask(anchors, 1.3, q)
    assert got.shape == (20, local_width(CHANNELS, len(BANDWIDTHS)))
    np.testing.assert_allclose(got, one_by_one(params, anchors, 1.3, q), atol=2e-4)


def test_masked_anchors_change_nothing(lookup):
    _, ask = lookup
    q = np.random.default_rng(1).uniform(-0.6, 0.6, (10, 3))
    few = random_anchors(12)
    junk = random_anchors(7, seed=5)
    more = jax.tree.map(lambda a, b: np.concatenate([a, b]), few, junk)
    more = dataclasses.replace(more, mask=np.arange(19) < 12)
    np.testing.assert_allclose(ask(more, 1.0, q), ask(few, 1.0, q), atol=1e-5)


def test_duplicate_anchors_count_as_weight_and_stay_finite(lookup):
    params, ask = lookup
    one = jax.tree.map(lambda x: np.repeat(x[:1], 9, axis=0), random_anchors(1))
    q = np.concatenate([np.asarray(one.offset[:1]), [[0.0, 0.0, 0.0], [50.0, 0.0, 0.0]]])
    got = ask(one, 1.0, q)
    assert np.isfinite(got).all()
    single = jax.tree.map(lambda x: x[:1], one)
    np.testing.assert_allclose(got[1:], one_by_one(params, single, 1.0, q)[1:], rtol=2e-3, atol=2e-3)


def test_across_is_the_signed_distance_from_a_plane():
    """Anchors evenly on z = 0: what lies in the plane goes, what stands on it stays."""
    disc = np.random.default_rng(0).normal(size=(20_000, 3)) * [0.1, 0.1, 0.0]
    q = np.array([[0.05, -0.08, 0.03], [0.2, 0.0, -0.01], [0.0, 0.0, 0.0]])
    second = np.einsum("ai,aj->ij", disc, disc) / len(disc)
    tiled = (np.tile(x, (3, *[1] * x.ndim)).astype(np.float32) for x in (disc.mean(axis=0), second))
    _, across, spread = offsets(q.astype(np.float32), *tiled)
    np.testing.assert_allclose(across, q * [0, 0, 1], atol=3e-3)
    np.testing.assert_allclose(spread, 0.02, rtol=0.03)


@pytest.fixture(scope="module")
def prior():
    config = load_config(ROOT / "configs" / "small.yaml", TrainingRun).model
    assert config.decoder.local_blocks  # or the tests below say nothing
    return init_prior(config, jax.random.key(3))


@pytest.fixture(scope="module")
def cloud():
    return (np.random.default_rng(4).uniform(-0.5, 0.5, (200, 3)) * [1.0, 0.6, 0.4]).astype(np.float32)


@pytest.fixture(scope="module")
def pose():
    turn = Rotation.random(random_state=0).as_quat(scalar_first=True)
    return jaxlie.SE3(np.r_[turn, 3.0, -2.0, 1.0].astype(np.float32))


def test_field_moves_and_grows_with_the_cloud(prior, cloud, pose):
    """SDF(sRp + t; Φ(sRX + t)) = SDF(p; Φ(X)): encoding the moved cloud or moving its embedding."""
    mask, queries = np.ones(len(cloud), bool), 1.2 * cloud[:40]
    embedding = encoded(prior, cloud, mask)
    expected = distance(prior, embedding, queries)
    assert np.ptp(expected) > 0.01
    again = encoded(prior, moved_by(pose, cloud), mask)
    np.testing.assert_allclose(distance(prior, again, moved_by(pose, queries)), expected, atol=5e-4)
    # Moving the embedding is exact: in float64 nothing but rounding is left.
    with jax.enable_x64(True):
        exact_prior, e, exact_T, q = jax.tree.map(
            lambda x: np.asarray(x, np.float64) if x.dtype == np.float32 else x,
            (prior, embedding, pose, queries),
        )
        still = distance(exact_prior, e, q)
        carried = placed_by(e, exact_T, np.float64(2.5))
        np.testing.assert_allclose(distance(exact_prior, carried, moved_by(exact_T, q)), still, atol=1e-6)


@pytest.mark.slow
def test_gradients_are_finite_with_few_real_points(prior, cloud):
    mask = jnp.arange(len(cloud)) < 20

    def total(params, points, mask):
        weights = dataclasses.replace(prior, params=params)
        return jnp.abs(sdf_one(weights, encode_one(weights, points, mask), points[:30])).sum()

    gradient = jax.jit(jax.grad(total, argnums=(0, 1)))(prior.params, cloud, mask)
    gradient = jax.device_get(gradient)
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(gradient))
    assert float(np.abs(gradient[0]["decoder"]["local_1"]["slope"]).max()) > 0


# --- normals ------------------------------------------------------------------------------------------------


@jax.jit
def weights_of(q, position, bandwidth=0.1):
    """The blend's weights, every row summing to 1."""
    squared = jnp.sum((q[:, None] - position) ** 2, axis=-1)
    return jax.nn.softmax(-squared / (2 * bandwidth**2), axis=-1)


@jax.jit
def features_of(q, position, normal, near):
    weight = weights_of(q, position)
    return plane_features(q, weight, plane_rows(position, normal), near, weight @ position)


def asked_planes(q, position, normal, near=0.015):
    return np.asarray(features_of(q, position, normal, jnp.float32(near)), np.float64)


def unit_rows(rng, count):
    rows = rng.normal(size=(count, 3))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def planes_one_by_one(q, position, normal, near=0.015):
    """Every query and every anchor of known normal in a loop, heights by subtraction, float64."""
    rows = []
    for p, w in zip(q, np.asarray(weights_of(q, position), np.float64), strict=True):
        known = [j for j in range(len(position)) if normal[j].any()]
        heights = {j: normal[j] @ (p - position[j]) for j in known}

        def blend(v, heights=heights, known=known, p=p):
            share = sum(v[j] for j in known)
            mean = sum((v[j] * normal[j] for j in known), np.zeros(3)) / (share + LEAST_SHARE)
            return sum(v[j] * heights[j] for j in known) / (share + LEAST_SHARE), mean, share

        first, n, share = blend(w)
        near_weight = {j: w[j] * np.exp(-(heights[j] ** 2) / (2 * near**2)) for j in known}
        second, n_near, near_share = blend(near_weight)
        spread = np.sqrt(sum(w[j] * heights[j] ** 2 for j in known) / (share + LEAST_SHARE))
        rows.append(
            [
                share,
                first,
                first / (abs(first) + PLANE_REACH),
                n @ (p - w @ position),
                spread * share / (share + LEAST_SHARE),
                first / (spread + PLANE_REACH),
                np.linalg.norm(n) * share / (share + LEAST_SHARE),
                near_share,
                second,
                second / (abs(second) + PLANE_REACH / 2),
                np.linalg.norm(n_near) * share / (share + LEAST_SHARE),
            ]
        )
    return np.array(rows)


def test_plane_features_are_the_sums_over_known_anchors():
    rng = np.random.default_rng(0)
    q, position, normal = rng.uniform(-0.5, 0.5, (20, 3)), rng.uniform(-0.4, 0.4, (30, 3)), unit_rows(rng, 30)
    normal[rng.random(30) < 0.4] = 0
    got = asked_planes(*(x.astype(np.float32) for x in (q, position, normal)))
    assert got.shape == (20, NORMAL_FEATURES)
    np.testing.assert_allclose(got, planes_one_by_one(q, position, normal), atol=2e-4)


def test_nothing_known_is_nothing_said():
    rng = np.random.default_rng(1)
    q, position = (rng.uniform(-0.5, 0.5, (9, 3)).astype(np.float32) for _ in range(2))
    for normal in (None, np.zeros((9, 3), np.float32)):
        assert not asked_planes(q, position, normal).any()


def test_heights_of_a_thin_board_have_the_sign_of_the_nearer_side():
    """Two sheets 0.03 apart facing away from one another: inside both blends are negative, outside positive."""
    side = np.stack(np.meshgrid(*[np.linspace(-0.3, 0.3, 25)] * 2), axis=-1).reshape(-1, 2)
    sheets = [np.c_[side, np.full(len(side), z)] for z in (-0.015, 0.015)]
    position = np.concatenate(sheets).astype(np.float32)
    normal = np.repeat(np.float32([[0, 0, -1], [0, 0, 1]]), len(side), axis=0)
    z = np.array([-0.05, -0.025, -0.01, 0.0, 0.01, 0.025, 0.05])
    q = np.c_[0.01 + 0 * z, 0.02 + 0 * z, z].astype(np.float32)
    found = asked_planes(q, position, normal)
    inside = np.abs(z) < 0.015
    assert (found[inside][:, [1, 8]] < 0).all()
    assert (found[~inside][:, 8] > 0).all()
    # Outward turned inward changes the sign of every height and nothing else.
    turned = asked_planes(q, position, -normal)
    sign = np.array([1, -1, -1, -1, 1, -1, 1, 1, -1, -1, 1])
    np.testing.assert_allclose(turned, sign * found, atol=1e-5)


@pytest.fixture(scope="module")
def seeing():
    """A small random prior whose decoder looks normals up."""
    model = load_config(ROOT / "configs" / "tiny.yaml", TrainingRun).model
    decoder = dataclasses.replace(
        model.decoder,
        narrow_skip=False,
        local_blocks=(1, 3),
        local_channels=4,
        bandwidths=(0.1,),
        normals=True,
    )
    return init_prior(dataclasses.replace(model, decoder=decoder), jax.random.key(3))


def test_a_field_with_normals_moves_with_the_object_and_depends_on_them(seeing, cloud, pose):
    normals = unit_rows(np.random.default_rng(5), len(cloud)).astype(np.float32)
    normals[::3] = 0.0
    mask, queries = np.ones(len(cloud), bool), 1.2 * cloud[:40]
    embedding = encoded(seeing, cloud, mask, normals)
    expected = distance(seeing, embedding, queries)
    there = moved_by(pose, queries)
    again = encoded(seeing, moved_by(pose, cloud), mask, turned_by(pose, normals))
    np.testing.assert_allclose(distance(seeing, again, there), expected, atol=5e-4)
    carried = placed_by(embedding, pose, jnp.float32(2.5))
    np.testing.assert_allclose(distance(seeing, carried, there), expected, atol=5e-4)
    for other in (-normals, np.zeros_like(normals)):
        blind = encoded(seeing, cloud, mask, other)
        assert np.abs(distance(seeing, blind, queries) - expected).max() > 1e-3
        for name in ("inv", "eqv", "scale", "center"):  # codes are of positions alone
            np.testing.assert_array_equal(getattr(blind, name), getattr(embedding, name))


@pytest.mark.slow
def test_gradients_with_normals_are_finite_where_few_are_known(seeing, cloud):
    mask, normals = np.arange(len(cloud)) < 20, np.zeros_like(cloud)
    normals[0, 2] = 1.0

    def total(params, points, mask, normals):
        weights = dataclasses.replace(seeing, params=params)
        return jnp.abs(sdf_one(weights, encode_one(weights, points, mask, normals), points[:30])).sum()

    gradient = jax.jit(jax.grad(total, argnums=(0, 1, 3)))(seeing.params, cloud, mask, normals)
    gradient = jax.device_get(gradient)
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(gradient))
    assert np.abs(gradient[0]["decoder"]["local_1"]["log_near_plane"]) > 0


def test_the_normals_of_a_scans_instances_reach_the_anchors(seeing):
    """Of points on a sphere the normal is the direction; an instance without normals has none that are known."""
    unit = unit_rows(np.random.default_rng(6), 300)
    shells = [Instance(id=1, points=unit + 5.0, normals=unit), Instance(id=2, points=unit - 5.0)]
    config = dataclasses.replace(preset("paper"), min_points=1)
    scene = start_scene(seeing, Scan(name="a", source="", instances=tuple(shells)), config)
    known, unknown = (o.embedding.anchors[0] for o in scene.objects)
    position = known.offset + scene.objects[0].embedding.scan_center() - 5.0
    np.testing.assert_allclose(np.asarray(known.normal)[known.mask], position[known.mask], atol=1e-3)
    assert known.mask.sum() > 10 and not np.asarray(unknown.normal).any()
