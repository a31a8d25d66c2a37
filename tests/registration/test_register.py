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
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from more2_jax.config import DescentRegistration, SurfaceRegistration, SurfaceSearch
from more2_jax.geometry.padding import pad_clouds
from more2_jax.geometry.points import cloud_radius
from more2_jax.geometry.transform import rescale
from more2_jax.network.embedding_batch import embed
from more2_jax.network.prior import encode, load_prior, sdf, shipped_priors
from more2_jax.registration import register_pairs as registration
from more2_jax.registration.descent import registration_loss, sampled
from more2_jax.registration.pair_batch import batch_of, local_batch, pair_up
from more2_jax.registration.pose_costs import APART_DEG, lowest_apart
from more2_jax.registration.register_pairs import register
from more2_jax.registration.search import scaled_pose
from more2_jax.types import ObservedObject

POINTS = 512  # of every cloud registered by surfaces here: compiled once a prior
# Fewer points than the preset: the clouds are clean, and what is tested is the same.
SURFACE = SurfaceRegistration(search=SurfaceSearch(points=64, dense=256, cells=16, keep=4))
PAPER = DescentRegistration(points=64, sdf_points=64, steps=5, icp_steps=3)
# Random weights any way up, shipped weights upright (the demo registers with them as well).
CASES = [
    ("tiny", "free"),
    *[pytest.param(name, "upright", marks=pytest.mark.slow) for name in shipped_priors()],
]


def clouds_of(clouds):
    return pad_clouds(clouds, POINTS)


def pairs_of(prior, source, target):
    return pair_up(*(batch_of(c, encode(prior, c)) for c in (source, target)))


def register_clouds(prior, source, target, motion="free", method=SURFACE):
    """Poses between the frames of padded clouds, 4×4 each, and the records of the registrations."""
    pairs = pairs_of(prior, source, target)
    result = register(prior, pairs, method, motion)
    return pairs.to_world(result.T_target_source), result


def moved(clouds, poses, seed=0):
    """The clouds at their poses, the order of the points lost."""
    rng = np.random.default_rng(seed)
    return [pieces.apply(T, rng.permutation(x)) for x, T in zip(clouds, poses, strict=True)]


def furniture():
    return [pieces.surface(m, POINTS) for m in pieces.without_symmetry()]


def assert_recovered(found, poses, clouds):
    for got, T, cloud in zip(found, poses, clouds, strict=True):
        degrees, meters = pieces.pose_error(got, T, cloud)
        assert degrees < 0.5 and meters < 0.005 * pieces.size(cloud)


# --- the law ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "motion"), CASES)
def test_registering_x_to_tx_recovers_t_and_the_way_back_its_inverse(tiny_prior, name, motion):
    prior, clouds = tiny_prior if name == "tiny" else load_prior(name), furniture()
    rng = np.random.default_rng(1)
    poses = [pieces.random_pose(rng, upright=motion == "upright") for _ in clouds]
    source, target = clouds_of(clouds), clouds_of(moved(clouds, poses))
    there, record = register_clouds(prior, source, target, motion)
    back, _ = register_clouds(prior, target, source, motion)
    assert len(clouds) >= 8
    assert_recovered(there, poses, clouds)
    assert bool(record.converged.all())
    for T_ab, T_ba, cloud in zip(there, back, clouds, strict=True):
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
    for got, T, cloud in zip(found, surveyed, source, strict=True):
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


def test_what_drifted_a_little_is_held_where_it_was_and_aligned_beside(tiny_prior):
    """Less than the noise of a point, so that both fit; more than that of all points together."""
    clouds, rng = furniture()[:3], np.random.default_rng(0)
    drift = [pieces.pose(Rotation.identity(), [0.005 * pieces.size(x), 0, 0]) for x in clouds]
    noisy = [[x + rng.normal(0, 0.005 * pieces.size(x), x.shape) for x in clouds] for _ in range(2)]
    pairs = pairs_of(tiny_prior, clouds_of(noisy[0]), clouds_of(moved(noisy[1], drift)))
    record = register(tiny_prior, pairs, SURFACE, "free")
    np.testing.assert_allclose(pairs.to_world(record.T_target_source), [np.eye(4)] * 3, atol=1e-6)
    for T, true, cloud in zip(pairs.to_world(record.aligned), drift, clouds, strict=True):
        off, held = (pieces.pose_error(x, true, cloud)[1] for x in (T, np.eye(4)))
        assert off < 0.8 * held


def test_what_is_known_to_stand_is_held_whatever_fits_closer(tiny_prior):
    clouds = furniture()[:2]
    poses = [pieces.random_pose(np.random.default_rng(k), upright=False) for k in range(2)]
    pairs = pairs_of(tiny_prior, clouds_of(clouds), clouds_of(moved(clouds, poses)))
    pairs = dataclasses.replace(pairs, stands=np.array([True, False]))
    found = pairs.to_world(register(tiny_prior, pairs, SURFACE, "free").T_target_source)
    np.testing.assert_allclose(found[0], np.eye(4), atol=1e-6)
    assert_recovered(found[1:], poses[1:], clouds[1:])


@pytest.mark.optimized  # as users search, so compiled as theirs
def test_flat_straight_and_single_points_are_laid_onto_themselves(tiny_prior):
    """A line turned round nearly is itself, so that rounding may choose: each is where the other's points are."""
    cloud = furniture()[0]
    degenerate = [cloud * [1, 1, 0], cloud * [1, 0, 0], cloud[:1], np.repeat(cloud[:2], 10, axis=0)]
    poses = [pieces.random_pose(np.random.default_rng(k), upright=False) for k in range(4)]
    sides = clouds_of(degenerate), clouds_of(moved(degenerate, poses))
    found, record = register_clouds(tiny_prior, *sides, method=SurfaceRegistration())
    assert np.isfinite(found).all() and bool(jnp.isfinite(record.rms_m).all())
    for got, T, x in zip(found, poses, degenerate, strict=True):
        laid, true = pieces.apply(got, x), pieces.apply(T, x)
        gaps = [cKDTree(there).query(here)[0].mean() for here, there in ((laid, true), (true, laid))]
        assert max(gaps) < 0.005 * max(pieces.size(x), 1e-3)


# --- the paper's settings ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def still(tiny_prior):
    """Seven pieces twice, other points each time; padded as scenes are."""
    clouds = furniture()[:7]
    sides = [observed(tiny_prior, c) for c in (clouds, moved(clouds, [np.eye(4)] * 7, seed=5))]
    return pair_up(*map(local_batch, sides))


def observed(prior, clouds):
    return [ObservedObject(points=p, embedding=e) for p, e in zip(clouds, embed(prior, clouds), strict=True)]


def test_the_loss_returned_is_that_of_the_pose_returned(tiny_prior, still):
    result = register(tiny_prior, still, PAPER)

    @jax.jit
    @partial(jax.vmap, in_axes=(None, 0, 0))
    def loss_of(prior, pair, T):
        pair = sampled(pair, PAPER)
        radius = cloud_radius(pair.target.points, pair.target.mask)
        return registration_loss(prior, rescale(pair, 1 / radius), PAPER)(scaled_pose(T, 1 / radius))

    expected = loss_of(tiny_prior, still.local(), result.T_target_source)
    np.testing.assert_allclose(result.loss, expected, rtol=1e-4)


@pytest.mark.slow
def test_of_several_candidates_the_one_that_ends_with_the_lowest_residual_is_returned(tiny_prior, still):
    pair = jax.tree.map(lambda x: x[:1], still.local())
    turns = jax.vmap(jaxlie.SO3.from_z_radians)(jnp.deg2rad(jnp.array([180.0, 2.0, 90.0])))
    starts = jaxlie.SE3.from_rotation_and_translation(turns, jnp.zeros((3, 3)))
    alone = [
        register(
            tiny_prior,
            dataclasses.replace(pair, candidates=jaxlie.SE3(starts.wxyz_xyz[None, k : k + 1])),
            PAPER,
        )
        for k in range(3)
    ]
    together = register(
        tiny_prior, dataclasses.replace(pair, candidates=jaxlie.SE3(starts.wxyz_xyz[None])), PAPER
    )
    best = int(np.argmin([float(r.rms_m[0]) for r in alone]))
    assert best == 1
    for name in ("loss", "rms_m"):
        # The clouds are the same: what is left is rounding, far below a micrometer.
        np.testing.assert_allclose(getattr(together, name), getattr(alone[best], name), rtol=1e-3, atol=1e-7)
    T, own = together.T_target_source, alone[best].T_target_source
    np.testing.assert_allclose(T.as_matrix(), own.as_matrix(), atol=1e-3)


def test_batches_of_different_size_are_refused(tiny_prior, still):
    two, three = still.source.take([0, 1]), still.target.take([0, 1, 2])
    with pytest.raises(ValueError, match=r"\[2, 2, 3, 3\].*needed equal numbers"):
        pair_up(two, three)


@pytest.mark.parametrize("method", [SURFACE, PAPER], ids=["surface", "descent"])
def test_records_of_another_encoder_are_refused_where_the_decoder_would_be_asked(tiny_prior, method):
    cloud = clouds_of(furniture()[:1])
    other = encode(tiny_prior, cloud)  # without anchors, which `small` looks up
    pairs = pair_up(batch_of(cloud, other), batch_of(cloud, other))
    with pytest.raises(ValueError, match=r"register got embeddings with 0 levels of anchors.*needed 2"):
        register(load_prior("small"), pairs, method)
    with pytest.raises(ValueError, match=r"sdf got embeddings with 0 levels of anchors.*needed 2"):
        sdf(load_prior("small"), other, np.zeros((1, 1, 3)))


@pytest.mark.slow
def test_records_of_another_encoder_are_registered_where_the_prior_is_not_asked(tiny_prior):
    clouds, rng = furniture(), np.random.default_rng(1)
    poses = [pieces.random_pose(rng, upright=True) for _ in clouds]
    # The codes have no anchors, which `small` looks up.
    pairs = pairs_of(tiny_prior, clouds_of(clouds), clouds_of(moved(clouds, poses)))
    unasked = dataclasses.replace(SURFACE, search=dataclasses.replace(SURFACE.search, field_weight=0.0))
    result = register(load_prior("small"), pairs, unasked, "upright")
    assert_recovered(pairs.to_world(result.T_target_source), poses, clouds)


def test_scenes_of_like_size_share_one_program(tiny_prior):
    programs = []
    for count in (5, 7):
        batch = local_batch(observed(tiny_prior, furniture()[:count]))
        register(tiny_prior, pair_up(batch, batch), PAPER)
        programs.append(registration._by_descent._cache_size())
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
