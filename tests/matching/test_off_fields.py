"""How far clouds lie from the surfaces that the prior completes the other with: definition, laws, what it is for."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pieces
import pytest
from scipy.spatial.transform import Rotation

from more2_jax.config import preset
from more2_jax.geometry.padding import pad_clouds
from more2_jax.geometry.point_to_plane import thinned, whole_surface
from more2_jax.network.prior import encode, load_prior, sdf_one
from more2_jax.registration import pose_costs
from more2_jax.registration.pose_costs import ABOUT_AS_WELL, OFF_FIELD, field_cost

POINTS, COUNT = 512, 64
off_both_ways = jax.jit(pose_costs.off_fields)
surface_of = jax.jit(whole_surface)


@pytest.fixture(scope="module")
def prior():
    return load_prior("small")


def pair_of(prior, source, target):
    """Two clouds in one frame, about a common zero, as surfaces; and their codes."""
    cloud = pad_clouds([source, target], POINTS)
    zero = np.asarray(cloud.origin).mean(axis=0)
    points = np.asarray(cloud.points) + (np.asarray(cloud.origin) - zero)[:, None]
    cloud = dataclasses.replace(cloud, points=jnp.asarray(points, jnp.float32), origin=None)
    codes = [jax.tree.map(lambda x, k=k: x[k], encode(prior, cloud)) for k in range(2)]
    return [surface_of(p, m) for p, m in zip(cloud.points, cloud.mask, strict=True)], codes


def poses_of(*matrices):
    return jax.tree.map(
        lambda *x: jnp.stack(x), *[jaxlie.SE3.from_matrix(jnp.asarray(T, jnp.float32)) for T in matrices]
    )


def off_fields(prior, poses, surfaces, codes, count):
    """The mean of both ways."""
    clouds = tuple(thinned(s, count).sampled for s in surfaces)
    return off_both_ways(prior, poses, clouds, tuple(codes)).mean(axis=1)


@pytest.fixture(scope="module")
def example(prior):
    piece = pieces.surface(pieces.without_symmetry()[0], 600)
    return pair_of(prior, piece[:300], piece[300:])


def test_it_is_the_mean_of_both_truncated_distances(prior, example):
    (source, target), codes = example
    T = pieces.pose(Rotation.from_euler("z", 20, degrees=True), np.array([0.05, 0.0, 0.02]))
    found = off_fields(prior, poses_of(T), *example, POINTS)
    shares = []
    for cloud, code, M in ((source.sampled, codes[1], T), (target.sampled, codes[0], np.linalg.inv(T))):
        points = pieces.apply(M, np.asarray(cloud.points)[np.asarray(cloud.mask)])
        distance = np.abs(sdf_one(prior, code, jnp.asarray(points, jnp.float32)))
        shares.append(np.minimum(distance / OFF_FIELD, 1).mean())
    np.testing.assert_allclose(found, [np.mean(shares)], rtol=1e-3)


def test_it_is_least_where_the_two_belong_and_1_far_away_or_nowhere(prior, example):
    half = pieces.pose(Rotation.from_euler("z", 180, degrees=True), np.zeros(3))
    away, lost = pieces.pose(Rotation.identity(), np.array([30.0, 0, 0])), np.full((4, 4), np.nan)
    right, turned, far, nowhere = off_fields(prior, poses_of(np.eye(4), half, away, lost), *example, COUNT)
    assert right < 0.5 and right < turned - 0.1
    assert far > 0.99 and nowhere == 1


def test_moving_the_target_moves_the_pose_alone(prior, example):
    surfaces, _ = example
    M = pieces.pose(Rotation.random(random_state=2), np.array([0.3, -0.2, 0.1]))
    source, target = (np.asarray(x.sampled.points)[np.asarray(x.sampled.mask)] for x in surfaces)
    moved = pair_of(prior, source, pieces.apply(M, target))
    # `pair_of` takes its zero between both clouds, so that of the source's frame moves, too.
    zero = (source.mean(axis=0) + pieces.apply(M, target).mean(axis=0)) / 2
    shift = pieces.pose(Rotation.identity(), -zero)
    here = off_fields(prior, poses_of(np.eye(4)), *pair_of(prior, source, target), POINTS)
    there = off_fields(prior, poses_of(shift @ M @ np.linalg.inv(shift)), *moved, POINTS)
    np.testing.assert_allclose(there, here, atol=5e-3)


def test_each_way_is_that_of_the_other_cloud(prior, example):
    surfaces, codes = example
    clouds = tuple(x.sampled for x in surfaces)
    T = pieces.pose(Rotation.from_euler("z", 20, degrees=True), np.array([0.05, 0.0, 0.02]))
    there = off_both_ways(prior, poses_of(T), clouds, tuple(codes))
    back = off_both_ways(prior, poses_of(np.linalg.inv(T)), clouds[::-1], tuple(codes[::-1]))
    np.testing.assert_allclose(there[0], back[0, ::-1], atol=1e-5)
    assert abs(there[0, 0] - there[0, 1]) > 1e-3


def test_it_chooses_among_poses_that_fit_about_as_well_and_no_others():
    costs = jnp.array([0.2, 0.2 + 0.9 * ABOUT_AS_WELL, 0.2 + 1.1 * ABOUT_AS_WELL])
    np.testing.assert_allclose(field_cost(costs, jnp.array([0.3, 0.1, 0.0]), 2.0), [0.6, 0.2, 2.0])


def test_robust_asks_for_it():
    assert preset("robust").registration.search.field_weight > 0
