"""Batches of objects and pairs: origins come and go without loss, fillers and order change nothing; old calls warn."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pieces
import pytest
from scipy.spatial.transform import Rotation

import more2_jax as m2
from more2_jax.config import DescentRegistration
from more2_jax.geometry.padding import MAX_POINTS, pad_clouds
from more2_jax.geometry.poses import local_poses, world_poses
from more2_jax.network.embedding_batch import embed
from more2_jax.network.prior import encode
from more2_jax.registration.pair_batch import (
    batch_of,
    local_batch,
    observe,
    pair_up,
    paired_rows,
    take_pairs,
)
from more2_jax.registration.register_pairs import register
from more2_jax.types import ObservedObject

KILOMETER = np.array([1000.0, -2000.0, 5.0])
QUICK = DescentRegistration(points=32, sdf_points=32, steps=2, icp_steps=2)


def clouds_at(place, count=3):
    rng = np.random.default_rng(0)
    return [
        rng.normal(size=(40 + 10 * k, 3)) * [0.5, 0.3, 0.2] + place + [2.0 * k, 0, 0] for k in range(count)
    ]


@pytest.fixture(scope="module")
def objects(tiny_prior):
    clouds = clouds_at(KILOMETER)
    return [
        ObservedObject(points=p, embedding=e) for p, e in zip(clouds, embed(tiny_prior, clouds), strict=True)
    ]


# --- poses between frames ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(), (5,), (4, 3)])
def test_local_and_world_poses_undo_one_another(shape):
    rng = np.random.default_rng(len(shape))
    count = int(np.prod(shape))
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.random(count, random_state=0).as_matrix()
    # Objects of two scans, whose frames differ by a turn about a place nearby.
    source, target = (KILOMETER + rng.normal(size=(count, 3)) for _ in range(2))
    T[:, :3, 3] = target + rng.normal(size=(count, 3)) - np.einsum("nij,nj->ni", T[:, :3, :3], source)
    T, source, target = T.reshape(*shape, 4, 4), source.reshape(*shape, 3), target.reshape(*shape, 3)
    local = local_poses(T, target, source)
    assert np.abs(np.asarray(local.translation())).max() < 10
    back = world_poses(local, target, source)
    points = source[..., None, :] + rng.normal(size=(*shape, 7, 3))
    moved = (np.einsum("...ij,...nj->...ni", x[..., :3, :3], points) + x[..., None, :3, 3] for x in (T, back))
    np.testing.assert_allclose(*moved, atol=2e-6)


def test_a_pair_a_kilometer_from_zero_has_its_pose_to_a_micrometer(objects):
    batch = local_batch(objects, 4)
    T = np.eye(4)
    T[:3, 3] = [0.1234567, -0.2, 0.3]
    pairs = pair_up(batch, batch, T)
    np.testing.assert_allclose(pairs.to_world(pairs.stayed), np.tile(T, (4, 1, 1)), atol=1e-6)
    several = jaxlie.SE3(np.repeat(np.asarray(pairs.stayed.wxyz_xyz)[:, None], 3, axis=1))
    np.testing.assert_allclose(pairs.to_world(several), np.tile(T, (4, 3, 1, 1)), atol=1e-6)
    unmoved = pair_up(batch, batch)
    np.testing.assert_array_equal(unmoved.to_world(unmoved.stayed), np.tile(np.eye(4), (4, 1, 1)))


def test_without_origins_local_frames_are_the_frame_of_all(tiny_prior):
    clouds = pad_clouds(clouds_at(np.zeros(3)), 128)
    bare = dataclasses.replace(clouds, origin=None)
    batch = batch_of(bare, encode(tiny_prior, bare))
    pairs = pair_up(batch, batch)
    np.testing.assert_array_equal(pairs.stayed.as_matrix(), np.tile(np.eye(4), (3, 1, 1)))
    np.testing.assert_array_equal(pairs.to_world(pairs.stayed), np.tile(np.eye(4), (3, 1, 1)))


# --- batches ----------------------------------------------------------------------------------------------------


def test_a_batch_holds_what_was_seen_about_its_origin_whatever_fills_it_up(objects):
    for size in (None, 3, 8):
        batch = local_batch(objects, size)
        assert batch.cloud.points.shape == (size or 4, MAX_POINTS, 3)
        assert batch.cloud.origin is None and batch.code.origin is None and batch.origin.dtype == np.float64
        for k, o in enumerate(objects):
            real = np.asarray(batch.cloud.mask[k])
            there = np.asarray(batch.cloud.points[k], np.float64)[real] + batch.origin[k]
            np.testing.assert_allclose(np.sort(there, axis=0), np.sort(o.points, axis=0), atol=1e-6)
            np.testing.assert_allclose(
                batch.code.center[k] + batch.origin[k], o.embedding.scan_center(), atol=1e-5
            )
        for filler in range(len(objects), size or 4):
            np.testing.assert_array_equal(batch.cloud.points[filler], batch.cloud.points[0])


def test_codes_encoded_about_another_place_are_taken_about_the_clouds_origin(tiny_prior):
    clouds = clouds_at(KILOMETER)
    cloud, code = pad_clouds(clouds, 128), encode(tiny_prior, pad_clouds(clouds, 128))
    shift = np.array([0.5, -0.25, 1.0])
    elsewhere = dataclasses.replace(code, center=code.center - shift, origin=code.origin + shift)
    for given in (code, elsewhere):
        batch = batch_of(cloud, given)
        np.testing.assert_allclose(batch.code.center, code.center, atol=1e-6)
    own = observe(tiny_prior, clouds)
    np.testing.assert_allclose(own.code.inv, code.inv, atol=1e-5)
    np.testing.assert_array_equal(own.origin, cloud.origin)


def test_rows_are_taken_in_the_order_asked_for(objects):
    batch, order = local_batch(objects, 3), [2, 0, 2, 1]
    taken = batch.take(order)
    for name in ("cloud", "code"):
        for x, y in zip(*(jax.tree.leaves(getattr(b, name)) for b in (taken, batch)), strict=True):
            np.testing.assert_array_equal(x, np.asarray(y)[order])
    np.testing.assert_array_equal(taken.origin, batch.origin[order])
    assert taken.origin.dtype == np.float64
    pairs = paired_rows(batch, batch, np.array([[0, 1], [2, 0]]), np.eye(4))
    np.testing.assert_array_equal(pairs.source.origin, batch.origin[[0, 2]])
    np.testing.assert_array_equal(pairs.target.origin, batch.origin[[1, 0]])
    swapped = take_pairs(pairs, [1, 0])
    np.testing.assert_array_equal(swapped.stayed.wxyz_xyz, np.asarray(pairs.stayed.wxyz_xyz)[::-1])
    np.testing.assert_array_equal(swapped.source.origin, pairs.source.origin[::-1])
    assert len(swapped) == 2


def test_inside_a_compiled_program_pairs_are_those_outside(objects):
    batch = local_batch(objects, 4)

    def stayed(source_origin, target_origin):
        sides = (dataclasses.replace(batch, origin=o) for o in (source_origin, target_origin))
        return pair_up(*sides).stayed.wxyz_xyz

    near = np.asarray(batch.origin - batch.origin[0], np.float32)
    source, target = jnp.asarray(near), jnp.asarray(near[::-1].copy())
    np.testing.assert_allclose(jax.jit(stayed)(source, target), stayed(source, target), atol=1e-6)


# --- calls of version 0.1 ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("upright", [False, True])
def test_clouds_and_codes_side_by_side_are_registered_with_a_warning(tiny_prior, upright):
    source, target = (pad_clouds(clouds_at(p), 128) for p in (KILOMETER, KILOMETER + 0.1))
    codes = [encode(tiny_prior, c) for c in (source, target)]
    with pytest.warns(DeprecationWarning, match="pair_up"):
        old = register(tiny_prior, source, target, *codes, QUICK, upright)
    pairs = pair_up(*map(batch_of, (source, target), codes))
    new = register(tiny_prior, pairs, QUICK, "upright" if upright else "free")
    np.testing.assert_array_equal(old.T_target_source.wxyz_xyz, new.T_target_source.wxyz_xyz)
    poses = pairs.to_world(new.T_target_source)
    for k in range(3):
        T = jax.tree.map(lambda x, k=k: x[k], old.T_target_source)
        with pytest.warns(DeprecationWarning, match="PairBatch.to_world"):
            found = m2.world_pose(T, target.origin[k], source.origin[k])
        np.testing.assert_allclose(found, poses[k], atol=1e-12)


def test_a_pair_far_away_is_registered_as_one_at_zero(tiny_prior):
    results = []
    for place in (np.zeros(3), KILOMETER):
        clouds = clouds_at(place)
        turned = [
            (c - place) @ pieces.pose(Rotation.from_euler("z", 5, degrees=True), place)[:3, :3].T
            for c in clouds
        ]
        pairs = pair_up(observe(tiny_prior, clouds), observe(tiny_prior, [t + place for t in turned]))
        result = register(tiny_prior, pairs, QUICK)
        T = pairs.to_world(result.T_target_source)
        to_place = pieces.pose(Rotation.identity(), place)
        results.append(np.linalg.inv(to_place) @ T @ to_place)
    np.testing.assert_allclose(results[1], results[0], atol=1e-4)


def test_normals_stay_with_their_points_and_clouds_without_have_zeros(objects):
    rng = np.random.default_rng(3)
    unit = rng.normal(size=objects[0].points.shape)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    batch = local_batch([dataclasses.replace(objects[0], normals=unit), *objects[1:]], 4)
    assert local_batch(objects, 4).cloud.normals is None
    turned, real = np.asarray(batch.cloud.normals), np.asarray(batch.cloud.mask[0])
    assert not turned[1:3].any()
    there = np.asarray(batch.cloud.points[0], np.float64)[real] + batch.origin[0]
    row = np.linalg.norm(there[:, None] - objects[0].points, axis=-1).argmin(axis=1)
    np.testing.assert_allclose(turned[0][real], unit[row], atol=1e-6)
