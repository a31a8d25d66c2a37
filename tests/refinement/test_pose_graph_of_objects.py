"""Pose graphs of a scene's objects: slips shrink, records stay consistent, what is no part of it stays."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from factories import turn_z
from pieces import apply, surface, without_symmetry
from scipy.spatial.transform import Rotation

import more2_jax.refinement.pose_graph_of_objects
from more2_jax.config import preset
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
from more2_jax.tracking.objects import accumulated_points, new_object, points_of, seen_again
from more2_jax.types import Instance, Observation, ScanRecord

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
    o = new_object(0, 0, Instance(id=1, points=clouds[0]), embed(prior, clouds[:1])[0])
    for k in range(1, count):
        T_ref_scan = slip(k % 3) @ np.linalg.inv(turn_z(0.5 * k, np.zeros(3), SHIFTS[k % 3]))
        cloud = apply(turn_z(0.5 * k, np.zeros(3), SHIFTS[k % 3]), clouds[k])
        seen = Observation(scan=k, instance=1, T_ref_scan=T_ref_scan, score=1.0, rms_m=0.01, converged=True)
        o = seen_again(o, Instance(id=1, points=cloud), seen)
    return o, np.concatenate(clouds)


def records(count):
    """Scans whose sensors are not known."""
    return [ScanRecord(index=k, name=str(k), source="", instances=(1,)) for k in range(count)]


def off(o, true):
    return np.sqrt(np.mean(np.sum((accumulated_points(o) - true) ** 2, axis=1)))


def test_slips_shrink_to_a_fiftieth_and_records_agree(prior):
    o, true = seen_with_slips(prior)
    (new,) = refine_object_poses(prior, [o], [0], records(3), {0: 0.0}, CONFIG)
    assert off(o, true) > 0.004
    assert off(new, true) < 0.02 * off(o, true)
    np.testing.assert_array_equal(new.observations[0].T_ref_scan, o.observations[0].T_ref_scan)
    for before, after in zip(o.observations, new.observations, strict=True):
        np.testing.assert_allclose(points_of(new, after), points_of(o, before), atol=1e-9)
        R = after.T_ref_scan[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-5)
        np.testing.assert_allclose(R[2], [0, 0, 1], atol=1e-6)  # upright
    np.testing.assert_allclose(new.embedding.inv, embed(prior, [accumulated_points(new)])[0].inv, atol=1e-6)


def test_any_orientation_far_from_zero(prior):
    o, true = seen_with_slips(prior)
    far = np.array([4e5, 5e6, 100.0])  # meters, as of a map's grid
    turn = Rotation.from_rotvec([0.4, 1.0, -0.3]).as_matrix()
    there, back = np.eye(4), np.eye(4)
    there[:3, :3], there[:3, 3] = turn, far
    back[:3, :3], back[:3, 3] = turn.T, -turn.T @ far
    cloud = apply(there, o.points[o.point_scan == 0])
    moved = new_object(0, 0, Instance(id=1, points=cloud), embed(prior, [cloud])[0])
    for seen in o.observations[1:]:
        pose = dataclasses.replace(seen, T_ref_scan=there @ seen.T_ref_scan)
        moved = seen_again(moved, Instance(id=1, points=points_of(o, seen)), pose)
    config = preset("robust")
    (new,) = refine_object_poses(prior, [moved], [0], records(3), {0: None}, config)
    found = dataclasses.replace(new, points=apply(back, new.points))
    assert off(found, true) < 0.02 * off(o, true)


def test_what_is_doubted_not_chosen_or_has_no_sides_stays(prior):
    o, _ = seen_with_slips(prior)
    doubted = dataclasses.replace(o.observations[1], accumulated=False)
    doubts = dataclasses.replace(o, observations=(o.observations[0], doubted, o.observations[2]))
    one, other = refine_object_poses(prior, [doubts, o], [0], records(3), {0: None}, CONFIG)
    assert other is o
    np.testing.assert_array_equal(one.observations[1].T_ref_scan, doubted.T_ref_scan)
    np.testing.assert_array_equal(one.points[one.point_scan == 1], o.points[o.point_scan == 1])
    assert not np.array_equal(one.observations[2].T_ref_scan, o.observations[2].T_ref_scan)
    plain = dataclasses.replace(CONFIG, meshing=dataclasses.replace(CONFIG.meshing, mls_bandwidth=0.0))
    (same,) = refine_object_poses(prior, [o], [0], records(3), {0: None}, plain)
    np.testing.assert_allclose(same.points, o.points, atol=1e-6)


def test_objects_of_different_numbers_of_scans_are_each_optimized_as_alone(prior):
    objects = [seen_with_slips(prior, count)[0] for count in (2, 3, 2)]
    scans = records(3)
    together = refine_object_poses(prior, objects, [0, 1, 2], scans, dict.fromkeys(range(3)), CONFIG)
    for o, new in zip(objects, together, strict=True):
        (alone,) = refine_object_poses(prior, [o], [0], scans, {0: None}, CONFIG)
        np.testing.assert_allclose(new.points, alone.points, atol=1e-5)


def test_of_many_observations_the_first_and_the_last_are_optimized(prior, monkeypatch):
    monkeypatch.setattr(more2_jax.refinement.pose_graph_of_objects, "MAX_OBSERVATIONS", 3)
    o, _ = seen_with_slips(prior, count=5)
    assert optimized_observations(o) == [0, 3, 4]
    (new,) = refine_object_poses(prior, [o], [0], records(5), {0: None}, CONFIG)
    moved = [
        not np.array_equal(a.T_ref_scan, b.T_ref_scan)
        for a, b in zip(o.observations, new.observations, strict=True)
    ]
    assert moved == [False, False, False, True, True]


def test_what_would_turn_too_far_has_slipped_and_stays_as_registered(prior):
    o, _ = seen_with_slips(prior)
    moves = np.tile(np.eye(4), (3, 1, 1))
    for k, deg in ((0, 5.0), (1, 2.9), (2, 3.1)):
        moves[k, :3, :3] = Rotation.from_rotvec([0, 0, np.deg2rad(deg)]).as_matrix()
    new = with_motions(o, moves, 3.0)
    for k in (0, 2):
        np.testing.assert_array_equal(new.observations[k].T_ref_scan, o.observations[k].T_ref_scan)
        np.testing.assert_allclose(new.points[o.point_scan == k], o.points[o.point_scan == k], atol=1e-12)
    turned = new.observations[1].T_ref_scan[:3, :3] @ o.observations[1].T_ref_scan[:3, :3].T
    np.testing.assert_allclose(turned, moves[1, :3, :3], atol=1e-9)


def test_only_among_noise_may_what_turns_far_have_slipped(prior):
    o, _ = seen_with_slips(prior, count=2)
    (exact, _) = sides = list(observation_surfaces(prior, o, records(2), None, CONFIG))
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
    np.testing.assert_array_equal(
        with_motions(o, moves, 3.0).observations[1].T_ref_scan, o.observations[1].T_ref_scan
    )


@pytest.mark.parametrize("row", [[None, None], [None]])
def test_observations_too_small_for_planes_are_gathered_as_nothing(row):
    batch = oriented_batch([row], 2)
    assert not batch.mask.any()
    assert float(batch.residual[0]) == 0
