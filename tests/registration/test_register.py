"""Registration of X to TX recovers T: whatever the weights, the pose, the unit, the padding; and what is compiled."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pieces
import pytest
import trimesh
from compiling import quick_jit
from scipy.spatial.transform import Rotation

from more2_jax.config import RegistrationConfig, preset
from more2_jax.geometry.padding import pad_batch, pad_clouds
from more2_jax.geometry.points import sample
from more2_jax.geometry.poses import world_pose
from more2_jax.network.embedding_batch import SMALLEST_BATCH, at_zero, padded, stack, unstack
from more2_jax.network.prior import encode, encode_one, load_prior, sdf, shipped_priors
from more2_jax.registration import register as registration
from more2_jax.registration.register import register, register_one
from more2_jax.registration.starting_poses import Pair
from more2_jax.registration.surface import APART_DEG, lowest_apart

BATCH, POINTS = 16, 512  # of every robust registration here: compiled once a prior
# Fewer points than the preset: the clouds are clean, and what is tested is the same.
FEWER = {"points": 64, "coarse_points": 64, "coarse_dense": 256, "cells": 16, "keep_starts": 4}
FREE, UPRIGHT = (
    dataclasses.replace(preset("robust", upright=up).registration, **FEWER) for up in (False, True)
)
PAPER = RegistrationConfig(points=64, sdf_points=64, steps=5, icp_steps=3)
# Random weights any way up, shipped weights upright.
CASES = [
    ("tiny", False),
    *[pytest.param(name, True, marks=[pytest.mark.slow] * (name != "small")) for name in shipped_priors()],
]


def clouds_of(clouds):
    return pad_batch(pad_clouds(clouds, POINTS), BATCH)


def register_clouds(prior, source, target, *, upright=False):
    """Poses between the frames of padded clouds, 4×4 each, and the records of the registrations."""
    config = UPRIGHT if upright else FREE
    result = register(prior, source, target, encode(prior, source), encode(prior, target), config, upright)
    return world_poses(result, source, target), result


def world_poses(result, source, target):
    host = jax.device_get(result.T_target_source)
    rows = [jax.tree.map(lambda x, k=k: x[k], host) for k in range(len(source.points))]
    return [world_pose(T, target.origin[k], source.origin[k]) for k, T in enumerate(rows)]


def moved(clouds, poses, seed=0):
    """The clouds at their poses, the order of the points lost."""
    rng = np.random.default_rng(seed)
    return [pieces.apply(T, rng.permutation(x)) for x, T in zip(clouds, poses, strict=True)]


def furniture():
    return [pieces.surface(m, POINTS) for m in pieces.without_symmetry()]


def assert_recovered(found, poses, clouds):
    for got, T, cloud in zip(found, poses, clouds, strict=False):
        degrees, meters = pieces.pose_error(got, T, cloud)
        assert degrees < 0.5 and meters < 0.005 * pieces.size(cloud)


# --- the law ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "upright"), CASES)
def test_registering_x_to_tx_recovers_t_and_the_way_back_its_inverse(tiny_prior, name, upright):
    prior, clouds = tiny_prior if name == "tiny" else load_prior(name), furniture()
    rng = np.random.default_rng(1)
    poses = [pieces.random_pose(rng, upright=upright) for _ in clouds]
    source, target = clouds_of(clouds), clouds_of(moved(clouds, poses))
    there, record = register_clouds(prior, source, target, upright=upright)
    back, _ = register_clouds(prior, target, source, upright=upright)
    assert len(clouds) >= 8
    assert_recovered(there, poses, clouds)
    assert bool(record.converged.all())
    for T_ab, T_ba, cloud in zip(there, back, clouds, strict=False):
        degrees, meters = pieces.pose_error(T_ab @ T_ba, np.eye(4), cloud)
        assert degrees < 0.5 and meters < 0.005 * pieces.size(cloud)


def test_next_to_nothing_half_a_turn_and_any_unit(tiny_prior):
    chair = furniture()[4]
    axis = Rotation.random(6, random_state=2).apply([0, 0, 1.0])
    turns = [
        Rotation.from_rotvec(np.deg2rad(d) * a)
        for d, a in zip([0.1, 0.1, 179.9, 180, 180, 90], axis, strict=True)
    ]
    shifts = [[1e-3, 0, 0], [0, 0, 0], [1, 2, 3], [0, 0, 0], [5, 0, 0], [1e-3, 0, 0]]
    scales = [1.0, 1.0, 1.0, 1.0, 0.01, 100.0]
    poses = [pieces.pose(r, s * np.array(t)) for r, t, s in zip(turns, shifts, scales, strict=True)]
    clouds = [chair * s for s in scales]
    found, _ = register_clouds(tiny_prior, clouds_of(clouds), clouds_of(moved(clouds, poses)))
    assert_recovered(found, poses, clouds)


def test_kilometers_from_zero_cost_no_precision(tiny_prior):
    clouds, far = furniture(), np.array([1000.0, -2000.0, 5.0])
    rng = np.random.default_rng(3)
    poses = [pieces.random_pose(rng, upright=False) for _ in clouds]
    away = pieces.pose(Rotation.identity(), far)
    surveyed = [away @ T @ np.linalg.inv(away) for T in poses]
    source = [x + far for x in clouds]
    found, _ = register_clouds(tiny_prior, clouds_of(source), clouds_of(moved(source, surveyed)))
    for got, T, cloud in zip(found, surveyed, source, strict=False):
        gap = np.linalg.norm(pieces.apply(got, cloud) - pieces.apply(T, cloud), axis=1)
        assert gap.max() < 1e-4 * pieces.size(cloud)


@pytest.mark.parametrize("junk", [1e6, np.nan])
def test_what_stands_in_masked_rows_changes_nothing(tiny_prior, junk):
    clouds = [x[: 300 + 10 * k] for k, x in enumerate(furniture())]
    poses = [pieces.random_pose(np.random.default_rng(k), upright=False) for k in range(len(clouds))]
    source, target = clouds_of(clouds), clouds_of(moved(clouds, poses))
    clean, _ = register_clouds(tiny_prior, source, target)
    dirty = [
        dataclasses.replace(c, points=jnp.where(c.mask[..., None], c.points, junk)) for c in (source, target)
    ]
    found, _ = register_clouds(tiny_prior, *dirty)
    np.testing.assert_allclose(found, clean, atol=1e-5)
    assert_recovered(found, poses, clouds)


def test_a_symmetric_object_that_stayed_is_said_to_have_stayed(tiny_prior):
    can = trimesh.creation.cylinder(radius=0.2, height=0.6)
    source, target = (trimesh.sample.sample_surface(can, POINTS, seed=s)[0] + [3.0, 1, 0.3] for s in (0, 1))
    found, _ = register_clouds(tiny_prior, clouds_of([np.asarray(source)]), clouds_of([np.asarray(target)]))
    np.testing.assert_allclose(found[0], np.eye(4), atol=1e-6)


def test_flat_straight_and_single_points_give_finite_poses(tiny_prior):
    cloud = furniture()[0]
    degenerate = [cloud * [1, 1, 0], cloud * [1, 0, 0], cloud[:1], np.repeat(cloud[:2], 10, axis=0)]
    poses = [pieces.random_pose(np.random.default_rng(k), upright=False) for k in range(4)]
    found, record = register_clouds(tiny_prior, clouds_of(degenerate), clouds_of(moved(degenerate, poses)))
    assert np.isfinite(found).all() and bool(jnp.isfinite(record.rms_m).all())
    for got, T, x in zip(found, poses, degenerate, strict=False):
        gap = np.linalg.norm(pieces.apply(got, x).mean(axis=0) - pieces.apply(T, x).mean(axis=0))
        assert gap < 0.005 * max(pieces.size(x), 1e-3)


# --- the paper's settings ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def still(tiny_prior):
    """Seven pieces twice, other points each time, and their codes; padded as scenes are."""
    clouds = furniture()[:7]
    source, target = (padded(c) for c in (clouds, moved(clouds, [np.eye(4)] * 7, seed=5)))
    return source, target, encode(tiny_prior, source), encode(tiny_prior, target)


def first(count, batch):
    return jax.tree.map(lambda x: x[:count], batch)


def test_the_loss_returned_is_that_of_the_pose_returned(tiny_prior, still):
    result = register(tiny_prior, *still, PAPER)

    @jax.jit
    @partial(jax.vmap, in_axes=(None, 0, 0, 0))
    def loss_of(prior, clouds, codes, T):
        (source, target), (source_mask, target_mask) = clouds
        pair = pair_of(source, target, source_mask, target_mask, codes)
        radius = registration.cloud_radius(pair.target.points, pair.target.mask)
        loss = registration.registration_loss(prior, registration.rescale(pair, 1 / radius), PAPER)
        return loss(jaxlie.SE3.from_rotation_and_translation(T.rotation(), T.translation() / radius))

    clouds = [[getattr(c, name) for c in still[:2]] for name in ("points", "mask")]
    # The very codes: encoded one at a time they differ in their last digits, and so does the field.
    expected = loss_of(tiny_prior, clouds, [at_zero(code) for code in still[2:]], result.T_target_source)
    np.testing.assert_allclose(result.loss, expected, rtol=1e-4)


def pair_of(source, target, source_mask, target_mask, codes, points=PAPER.points):
    return Pair(
        source=sample(source, source_mask, points, dense=False),
        target=sample(target, target_mask, points, dense=False),
        source_code=codes[0],
        target_code=codes[1],
        offset=jnp.zeros(3, source.dtype),
    )


def test_batches_of_different_size_are_refused(tiny_prior, still):
    (two, _, a, _), (three, _, b, _) = first(2, still), first(3, still)
    with pytest.raises(ValueError, match=r"\[2, 3, 2, 3\].*needed equal numbers"):
        register(tiny_prior, two, three, a, b, PAPER)


@pytest.mark.parametrize("config", [FREE, PAPER], ids=["robust", "paper"])
def test_records_of_another_encoder_are_refused_where_the_decoder_would_be_asked(tiny_prior, config):
    source, target = clouds_of(furniture()[:1]), clouds_of(furniture()[:1])
    other = encode(tiny_prior, target)  # without anchors, which `small` looks up
    with pytest.raises(ValueError, match=r"register got embeddings with 0 levels of anchors.*needed 2"):
        register(load_prior("small"), source, target, other, other, config)
    with pytest.raises(ValueError, match=r"sdf got embeddings with 0 levels of anchors.*needed 2"):
        sdf(load_prior("small"), other, np.zeros((BATCH, 1, 3)))


def test_records_of_another_encoder_are_registered_where_the_prior_is_not_asked(tiny_prior):
    clouds, rng = furniture(), np.random.default_rng(1)
    poses = [pieces.random_pose(rng, upright=True) for _ in clouds]
    source, target = clouds_of(clouds), clouds_of(moved(clouds, poses))
    codes = [encode(tiny_prior, c) for c in (source, target)]  # without anchors, which `small` looks up
    unasked = dataclasses.replace(UPRIGHT, field_weight=0.0)
    result = register(load_prior("small"), source, target, *codes, unasked, True)
    assert_recovered(world_poses(result, source, target), poses, clouds)


def test_scenes_of_like_size_share_one_program(tiny_prior, still):
    programs = []
    for count in (5, 7):
        cloud = padded(furniture()[:count])
        code, _ = stack(unstack(still[2], count))
        register(tiny_prior, cloud, cloud, code, code, PAPER)
        assert len(cloud.points) == SMALLEST_BATCH
        programs.append(registration._register_many._cache_size())
    assert programs[0] >= 1 and programs[0] == programs[1]


def test_the_poses_kept_are_the_best_that_lie_apart():
    rng = np.random.default_rng(0)
    for seed in range(20):
        rotations = Rotation.random(40, random_state=seed)
        cost = rng.random(40).astype(np.float32)
        kept = []
        for k in np.argsort(cost):
            if all(np.rad2deg((rotations[k].inv() * rotations[j]).magnitude()) >= APART_DEG for j in kept):
                kept.append(k)
        group = jaxlie.SO3(jnp.asarray(rotations.as_quat(scalar_first=True), jnp.float32))
        np.testing.assert_array_equal(lowest_apart(jnp.asarray(cost), group, 5), kept[:5])


# --- gradients --------------------------------------------------------------------------------------------------


def test_gradient_through_encoder_kabsch_and_refinement_agrees_with_finite_differences(tiny_prior):
    config = RegistrationConfig(points=32, sdf_points=32, steps=5, icp_steps=2)
    rng = np.random.default_rng(0)
    cloud = pieces.surface(pieces.without_symmetry()[4], 64) - [0, 0, 0.4]
    turned = pieces.apply(pieces.random_pose(rng, upright=False, reach=0.1), cloud)
    with jax.enable_x64(True):
        params = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), tiny_prior.params)

        @quick_jit
        @jax.value_and_grad
        def final_loss(source, target, every, prior):
            # Both in one go: half as much to compile.
            codes = jax.vmap(partial(encode_one, prior))(
                jnp.stack([source, target]), jnp.stack([every, every])
            )
            codes = [jax.tree.map(lambda x, k=k: x[k], codes) for k in (0, 1)]
            pair = pair_of(source, target, every, every, codes, config.points)
            return register_one(prior, pair, config, False).loss

        def at(source):
            prior = dataclasses.replace(tiny_prior, params=params)
            return final_loss(jnp.asarray(source), jnp.asarray(turned), np.ones(64, bool), prior)

        source = cloud + 0.01 * rng.normal(size=cloud.shape)
        gradient = at(source)[1]
        assert gradient.dtype == jnp.float64 and bool(jnp.isfinite(gradient).all())
        assert float(jnp.abs(gradient).max()) > 1e-4
        for _ in range(4):
            way, eps = rng.normal(size=cloud.shape), 1e-6
            slope = (at(source + eps * way)[0] - at(source - eps * way)[0]) / (2 * eps)
            assert float(jnp.vdot(gradient, way)) == pytest.approx(float(slope), rel=1e-3)
