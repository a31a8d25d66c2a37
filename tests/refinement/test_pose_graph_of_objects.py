"""Pose graphs of accumulated objects: slips shrink, points and poses agree, what has no planes stays."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from factories import turn_z
from pieces import apply, surface, without_symmetry
from scipy.spatial.transform import Rotation

import more2_jax.refinement.pose_graph_of_objects
from more2_jax.config import preset
from more2_jax.geometry.observations import own_points
from more2_jax.network.embedding_batch import embed
from more2_jax.network.prior import load_prior
from more2_jax.refinement.pose_graph_of_objects import (
    max_turn_deg,
    observation_surfaces,
    optimized_observations,
    oriented_batch,
    refine_object_poses,
    with_motions,
)
from more2_jax.types import AccumulatedObject

pytestmark = pytest.mark.optimized  # poses are refined for longer than that compiles

CONFIG = preset("robust", upright=True)
PIECE = without_symmetry()[0]
SHIFTS = np.array([[0.0, 0, 0], [2.0, 1, 0], [-1.0, 3, 0]])


@pytest.fixture(scope="module")
def prior():
    """The shipped one: lengths are in its canonical units."""
    return load_prior("small")


def slip(k: int) -> np.ndarray:
    """A few millimeters and about a degree, none of the first."""
    return turn_z(np.deg2rad([0.0, 1.0, -1.0][k]), np.zeros(3), np.array([0.004, -0.003, 0.0]) * k)


def seen_with_slips(prior, count=3):
    """A piece scanned `count` times, every pose but the first a little wrong; and the points where they belong."""
    clouds = [surface(PIECE, 3000, seed=k) for k in range(count)]
    places = [turn_z(0.5 * k, np.zeros(3), SHIFTS[k % 3]) for k in range(count)]
    poses = [slip(k % 3) @ np.linalg.inv(T) if k else np.eye(4) for k, T in enumerate(places)]
    seen = [apply(T, cloud) for T, cloud in zip(places, clouds, strict=True)]
    seen[0] = clouds[0]
    return laid_together(seen, poses, embed(prior, clouds[:1])[0]), np.concatenate(clouds)


def laid_together(seen, poses, code, floor_m=None):
    """What scans saw, each in its own frame, as one object; sensors are not known."""
    rng = np.random.default_rng(0)
    floor = np.zeros((0, 3))
    if floor_m is not None:
        floor = np.column_stack([rng.uniform(-3, 3, (4000, 2)), np.full(4000, floor_m)])
    return AccumulatedObject(
        points=np.concatenate([apply(T, cloud) for T, cloud in zip(poses, seen, strict=True)]),
        observation=np.repeat(np.arange(len(seen)), [len(cloud) for cloud in seen]),
        poses=np.stack(poses),
        embedding=code,
        sensors=(np.zeros((0, 3)),) * len(seen),
        background=floor,
    )


def off(o, true):
    return np.sqrt(np.mean(np.sum((o.points - true) ** 2, axis=1)))


@pytest.mark.slow
def test_slips_shrink_to_a_fiftieth_and_points_follow_their_poses(prior):
    o, true = seen_with_slips(prior)
    (new,) = refine_object_poses(prior, [o], CONFIG)
    assert off(o, true) > 0.004
    assert off(new, true) < 0.02 * off(o, true)
    np.testing.assert_array_equal(new.poses[0], o.poses[0])
    for j, T in enumerate(new.poses):
        np.testing.assert_allclose(own_points(new, j), own_points(o, j), atol=1e-9)
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-5)
        np.testing.assert_allclose(T[2, :3], [0, 0, 1], atol=1e-6)  # upright
    np.testing.assert_allclose(new.embedding.inv, embed(prior, [new.points])[0].inv, atol=1e-6)


def test_any_orientation_far_from_zero(prior):
    o, true = seen_with_slips(prior)
    far = np.array([4e5, 5e6, 100.0])  # meters, as of a map's grid
    turn = Rotation.from_rotvec([0.4, 1.0, -0.3]).as_matrix()
    there, back = np.eye(4), np.eye(4)
    there[:3, :3], there[:3, 3] = turn, far
    back[:3, :3], back[:3, 3] = turn.T, -turn.T @ far
    seen = [apply(there, own_points(o, 0)), *(own_points(o, j) for j in (1, 2))]
    moved = laid_together(seen, [np.eye(4), *(there @ T for T in o.poses[1:])], embed(prior, seen[:1])[0])
    (new,) = refine_object_poses(prior, [moved], preset("robust"))
    assert off(dataclasses.replace(new, points=apply(back, new.points)), true) < 0.02 * off(o, true)


def test_a_floor_is_kept_below(prior, monkeypatch):
    asked = []
    monkeypatch.setattr(
        more2_jax.refinement.pose_graph_of_objects, "lowest_height", lambda code, floor: asked.append(floor)
    )
    monkeypatch.setattr(more2_jax.refinement.pose_graph_of_objects, "observed_surface", lambda *_: None)
    o, _ = seen_with_slips(prior, count=2)
    lowest = o.points[:, 2].min()
    for floor_m in (None, lowest):
        seen = [own_points(o, j) for j in range(2)]
        list(observation_surfaces(prior, laid_together(seen, o.poses, o.embedding, floor_m), CONFIG))
    assert asked == [None, pytest.approx(lowest, abs=2e-3)]


def test_what_has_no_sides_stays(prior):
    o, _ = seen_with_slips(prior)
    plain = dataclasses.replace(CONFIG, meshing=dataclasses.replace(CONFIG.meshing, mls_bandwidth=0.0))
    (same,) = refine_object_poses(prior, [o], plain)
    np.testing.assert_allclose(same.points, o.points, atol=1e-6)
    assert refine_object_poses(prior, [], CONFIG) == []


def test_objects_of_different_numbers_of_scans_are_each_optimized_as_alone(prior):
    objects = [seen_with_slips(prior, count)[0] for count in (2, 3, 2)]
    for o, new in zip(objects, refine_object_poses(prior, objects, CONFIG), strict=True):
        (alone,) = refine_object_poses(prior, [o], CONFIG)
        np.testing.assert_allclose(new.points, alone.points, atol=1e-5)


def test_of_many_observations_the_first_and_the_last_are_optimized(prior, monkeypatch):
    monkeypatch.setattr(more2_jax.refinement.pose_graph_of_objects, "MAX_OBSERVATIONS", 3)
    o, _ = seen_with_slips(prior, count=5)
    assert optimized_observations(o) == [0, 3, 4]
    (new,) = refine_object_poses(prior, [o], CONFIG)
    moved = [not np.array_equal(a, b) for a, b in zip(o.poses, new.poses, strict=True)]
    assert moved == [False, False, False, True, True]


def test_what_would_turn_too_far_has_slipped_and_stays_as_registered(prior):
    o, _ = seen_with_slips(prior)
    moves = np.tile(np.eye(4), (3, 1, 1))
    for k, deg in ((0, 5.0), (1, 2.9), (2, 3.1)):
        moves[k, :3, :3] = Rotation.from_rotvec([0, 0, np.deg2rad(deg)]).as_matrix()
    new = with_motions(o, moves, 3.0)
    for k in (0, 2):
        np.testing.assert_array_equal(new.poses[k], o.poses[k])
        np.testing.assert_allclose(new.points[o.observation == k], o.points[o.observation == k], atol=1e-12)
    turned = new.poses[1][:3, :3] @ o.poses[1][:3, :3].T
    np.testing.assert_allclose(turned, moves[1, :3, :3], atol=1e-9)


def test_only_among_noise_may_what_turns_far_have_slipped(prior):
    o, _ = seen_with_slips(prior, count=2)
    (exact, _) = sides = list(observation_surfaces(prior, o, CONFIG))
    assert all(s.noiseless for s in sides)
    assert max_turn_deg([*sides, None]) == np.inf
    rough = dataclasses.replace(exact, noiseless=False)
    assert max_turn_deg([exact, rough, exact]) == np.inf  # most are
    assert max_turn_deg([exact, rough]) == max_turn_deg([None]) == 3.0


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_move_that_is_not_finite_is_none(prior, bad):
    o, _ = seen_with_slips(prior, count=2)
    moves = np.tile(np.eye(4), (2, 1, 1))
    moves[1, 0, 3] = bad
    np.testing.assert_array_equal(with_motions(o, moves, 3.0).poses[1], o.poses[1])


@pytest.mark.parametrize("row", [[None, None], [None]])
def test_observations_too_small_for_planes_are_gathered_as_nothing(row):
    batch = oriented_batch([row], 2)
    assert not batch.mask.any()
    assert float(batch.residual[0]) == 0
