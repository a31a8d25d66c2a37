"""Registration on completed surfaces, shipped weights: a known pose is found again from starts that are off."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pieces
import pytest
from scipy.spatial.transform import Rotation

from more2_jax.config import FieldRegistration
from more2_jax.geometry.padding import pad_clouds
from more2_jax.geometry.points import sample
from more2_jax.geometry.poses import local_poses
from more2_jax.network.prior import encode, field_sdf, load_prior, object_field
from more2_jax.registration import register_pairs as registration
from more2_jax.registration.field import LEAST_SLOPE, offsets
from more2_jax.registration.pair_batch import batch_of, pair_up
from more2_jax.registration.pose_costs import off_fields
from more2_jax.registration.register_pairs import register

POINTS = 512  # of every cloud
PIECES = 3
# Fewer points and starts than the preset: the clouds are clean and whole.
FIELD = FieldRegistration(turns=4, search_points=32, search_steps=4, keep=2, points=128, steps=8)
# What a completed surface misses its own points by, and so a pose laid by it: the field is learned, not measured.
DEGREES, SHARE = 1.0, 0.01


@pytest.fixture(scope="module")
def prior():
    return load_prior("small")


@pytest.fixture(scope="module")
def clouds():
    return [pieces.surface(m, POINTS) for m in pieces.without_symmetry()[:PIECES]]


def pairs_of(prior, source, target, candidates=None):
    """Clouds onto clouds, encoded; `candidates` (b, k, 4, 4) between the scans' own frames."""
    sides = [batch_of(c, encode(prior, c)) for c in (pad_clouds(x, POINTS) for x in (source, target))]
    pairs = pair_up(*sides)
    if candidates is None:
        return pairs
    origins = [np.repeat(np.asarray(s.origin)[:, None], candidates.shape[1], axis=1) for s in sides[::-1]]
    return dataclasses.replace(pairs, candidates=local_poses(candidates, *origins))


def moved(clouds, poses, seed=0):
    """The clouds at their poses, the order of the points lost."""
    rng = np.random.default_rng(seed)
    return [pieces.apply(T, rng.permutation(x)) for x, T in zip(clouds, poses, strict=True)]


def off_by(T, degrees, shift, cloud):
    """The pose after a turn about the vertical through the moved cloud's mean, and a shift, meters."""
    middle = pieces.apply(T, cloud).mean(axis=0)
    R = Rotation.from_euler("z", degrees, degrees=True)
    return pieces.pose(R, middle - R.apply(middle) + shift) @ T


def assert_recovered(found, poses, clouds):
    for got, T, cloud in zip(found, poses, clouds, strict=True):
        degrees, meters = pieces.pose_error(got, T, cloud)
        assert degrees < DEGREES and meters < SHARE * pieces.size(cloud)


@pytest.mark.parametrize("motion", ["upright", pytest.param("free", marks=pytest.mark.slow)])
def test_registering_x_to_tx_recovers_t_from_starts_that_are_off(prior, clouds, motion):
    rng = np.random.default_rng(1)
    poses = [pieces.random_pose(rng, upright=motion == "upright") for _ in clouds]
    off = np.array(
        [[off_by(T, d, [0.03, 0, 0], x) for d in (12, 100)] for T, x in zip(poses, clouds, strict=True)]
    )
    for start, T, x in zip(off[:, 0], poses, clouds, strict=True):
        assert pieces.pose_error(start, T, x)[0] > 10 * DEGREES
    pairs = pairs_of(prior, clouds, moved(clouds, poses), off)
    result = register(prior, pairs, FIELD, motion)
    found = pairs.to_world(result.T_target_source)
    assert_recovered(found, poses, clouds)
    assert bool(result.converged.all())
    if motion == "upright":
        np.testing.assert_allclose(found[:, :2, 2], 0, atol=1e-6)


@pytest.mark.slow
def test_next_to_nothing_half_a_turn_and_the_way_back(prior, clouds):
    """With starts of its own."""
    chair = clouds[:1] * 4
    turns = [Rotation.from_rotvec(np.deg2rad(d) * np.array([0, 0, 1.0])) for d in (0.1, 0.0, 179.9, 180.0)]
    shifts = [[1e-3, 0, 0], [0, 0, 0], [1, 2, 0], [0, 0, 0]]
    poses = [pieces.pose(r, np.array(t, float)) for r, t in zip(turns, shifts, strict=True)]
    pairs = pairs_of(prior, chair, moved(chair, poses))
    there = pairs.to_world(register(prior, pairs, FIELD, "upright").T_target_source)
    assert_recovered(there, poses, chair)
    pairs = pairs_of(prior, moved(chair, poses), chair)
    back = pairs.to_world(register(prior, pairs, FIELD, "upright").T_target_source)
    assert_recovered([a @ b for a, b in zip(there, back, strict=True)], [np.eye(4)] * 4, chair)


@pytest.mark.slow
def test_without_a_step_the_start_on_the_surfaces_is_chosen(prior, clouds):
    poses = [pieces.random_pose(np.random.default_rng(k), upright=True) for k in range(PIECES)]
    starts = np.array([[off_by(T, d, 0, x) for d in (90, 2, 45)] for T, x in zip(poses, clouds, strict=True)])
    pairs = pairs_of(prior, clouds, moved(clouds, poses), starts)
    none = dataclasses.replace(FIELD, search_steps=0, steps=0)
    found = pairs.to_world(register(prior, pairs, none, "upright").T_target_source)
    np.testing.assert_allclose(found, starts[:, 1], atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("junk", [1e6, np.nan])
def test_what_stands_in_masked_rows_changes_nothing(prior, clouds, junk):
    clouds = [x[: 300 + 10 * k] for k, x in enumerate(clouds)]
    pairs = pairs_of(prior, clouds, clouds)
    clean = register(prior, pairs, FIELD, "upright").T_target_source.as_matrix()

    def dirtied(side):
        points = jnp.where(side.cloud.mask[..., None], side.cloud.points, junk)
        return dataclasses.replace(side, cloud=dataclasses.replace(side.cloud, points=points))

    dirty = dataclasses.replace(pairs, source=dirtied(pairs.source), target=dirtied(pairs.target))
    found = register(prior, dirty, FIELD, "upright").T_target_source.as_matrix()
    assert not np.asarray(dirty.source.cloud.mask).all()
    np.testing.assert_allclose(found, clean, atol=1e-5)


@pytest.mark.slow
def test_flat_straight_and_single_points_give_finite_poses(prior, clouds):
    cloud = clouds[0]
    odd = [cloud * [1, 1, 0], cloud * [1, 0, 0], cloud[:1], np.repeat(cloud[:2], 10, axis=0)]
    # Any way up from two given starts, upright from its own.
    given = np.broadcast_to(
        np.stack([np.eye(4), pieces.pose(Rotation.identity(), [0.1, 0, 0])]), (4, 2, 4, 4)
    )
    for motion, candidates in (("free", given), ("upright", None)):
        pairs = pairs_of(prior, odd, odd, candidates)
        result = register(prior, pairs, FIELD, motion)
        assert np.isfinite(result.T_target_source.as_matrix()).all()
        assert bool(jnp.isfinite(result.rms_m).all()) and bool(jnp.isfinite(result.loss).all())


@pytest.mark.slow
def test_the_loss_returned_is_that_of_the_pose_returned(prior, clouds):
    pairs = pairs_of(prior, clouds, clouds)
    result = register(prior, pairs, FIELD, "upright")

    def off(pair, T):
        both = [sample(s.cloud.points, s.cloud.mask, FIELD.points) for s in (pair.source, pair.target)]
        one = jax.tree.map(lambda x: x[None], T)
        return off_fields(prior, one, tuple(both), (pair.source.code, pair.target.code)).mean()

    expected = jax.jit(jax.vmap(off))(pairs.local(), result.T_target_source)
    np.testing.assert_allclose(result.loss, expected, rtol=1e-3)


@pytest.mark.slow
def test_scenes_of_like_size_share_one_program(prior, clouds):
    programs = []
    for count in (PIECES - 1, PIECES):
        register(prior, pairs_of(prior, clouds[:count], clouds[:count]), FIELD, "upright")
        programs.append(registration._by_field._cache_size())
    assert programs[0] >= 1 and programs[0] == programs[1]


@pytest.mark.slow
def test_an_offset_is_the_field_over_its_slope(prior, clouds):
    """In float64: in float32 rounding moves points across kinks of ReLUs, where the slope jumps."""
    code = encode(prior, pad_clouds(clouds[:1], POINTS))
    code = jax.tree.map(lambda x: x[0], dataclasses.replace(code, origin=None))
    with jax.enable_x64(True):
        code, params = doubled(code), doubled(prior.params)
        prior = dataclasses.replace(prior, params=params)
        points = jnp.asarray(np.random.default_rng(0).normal(size=(64, 3)) * 0.3)
        field = object_field(prior, code)

        def meters(x):
            return code.scale * field_sdf(prior, field, x)

        distance, direction = jax.jit(offsets)(prior, field, points)
        slopes = jax.jit(jax.vmap(jax.grad(lambda p: meters(p[None])[0])))(points)
        length = np.linalg.norm(slopes, axis=1)
        steep = length > LEAST_SLOPE
        assert steep.sum() > 8
        np.testing.assert_allclose(distance[steep], (meters(points) / length)[steep], rtol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(direction[steep], axis=1), 1, rtol=1e-6)
        np.testing.assert_allclose(direction[~steep], slopes[~steep] / LEAST_SLOPE, rtol=1e-6, atol=1e-12)


def doubled(tree):
    """Its floats in double precision."""
    floating = jnp.floating
    return jax.tree.map(
        lambda x: jnp.asarray(x, jnp.float64) if jnp.issubdtype(x.dtype, floating) else x, tree
    )
