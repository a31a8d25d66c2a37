"""The frame that most pairs agree on: found among things that moved, left alone without need, its errors true."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from more2_jax.geometry.poses import apply_pose, rotation_error_deg
from more2_jax.tracking.pose_voting import (
    Votes,
    agreement,
    best_motion,
    estimate,
    most_agreed,
    position_sigma,
    room_misfit,
)

EYE = np.eye(4)


def pose(rng, motion="upright", far=20.0):
    yaw = motion == "upright"
    turn = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)) if yaw else Rotation.random(None, rng)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn.as_matrix(), rng.uniform(-far, far, 3)
    return T


def noisy(T, center, rng, sigma_m, sigma_deg, motion):
    """`T` with an error of place at `center` and of direction."""
    error = np.eye(4)
    turn = rng.normal(0, np.deg2rad(sigma_deg), 3) * ([0, 0, 1] if motion == "upright" else [1, 1, 1])
    error[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    at = apply_pose(T, center[None])[0]
    error[:3, 3] = at + rng.normal(0, sigma_m, 3) - error[:3, :3] @ at
    return error @ T


def votes_for(T, rng, stayed, moved, motion="upright", sigma_m=0.01, sigma_deg=0.5):
    """`stayed` pairs that say `T`, and a wrong way each; `moved` that say anything."""
    center = rng.uniform(-3, 3, (stayed + moved, 3))
    ways = [[noisy(T, c, rng, sigma_m, sigma_deg, motion), pose(rng, motion)] for c in center[:stayed]]
    ways += [[pose(rng, motion), pose(rng, motion)] for _ in range(moved)]
    every = np.arange(stayed + moved)
    return Votes(
        T_scene_scan=np.array(ways).reshape(-1, 2, 4, 4), center=center, object=every, instance=every
    )


def off(found, T, votes):
    return np.linalg.norm(apply_pose(found, votes.center) - apply_pose(T, votes.center), axis=1).max()


@pytest.mark.parametrize("motion", ["upright", "free"])
@pytest.mark.parametrize("seed", range(4))
def test_what_stayed_outvotes_what_moved(motion, seed):
    rng = np.random.default_rng(seed)
    T = pose(rng, motion)
    votes = votes_for(T, rng, stayed=4, moved=5, motion=motion)
    found = most_agreed(votes, motion, EYE)
    assert off(found, T, votes) < 0.04
    assert rotation_error_deg(found[:3, :3], T[:3, :3]) < 1.5


def test_the_frame_given_is_kept_to_the_last_bit_without_need():
    rng = np.random.default_rng(0)
    for stayed, moved in ((0, 8), (2, 0), (3, 3), (0, 0)):  # in the frame given
        votes = votes_for(EYE, rng, stayed, moved)
        np.testing.assert_array_equal(most_agreed(votes, "upright", EYE), EYE)
    few = votes_for(pose(rng), rng, 2, 4)  # two things put elsewhere together
    np.testing.assert_array_equal(most_agreed(few, "upright", EYE), EYE)
    together, still = votes_for(pose(rng), rng, 3, 0), votes_for(EYE, rng, 2, 0)  # three of five
    both = Votes(
        T_scene_scan=np.concatenate([together.T_scene_scan, still.T_scene_scan]),
        center=np.concatenate([together.center, still.center]),
        object=np.arange(5),
        instance=np.arange(5),
    )
    np.testing.assert_array_equal(most_agreed(both, "upright", EYE), EYE)


def test_one_object_has_one_voice_however_many_instances_are_like_it():
    rng = np.random.default_rng(1)
    votes = votes_for(pose(rng), rng, 4, 0)
    T = votes.T_scene_scan[0, 0]
    many = Votes(
        T_scene_scan=votes.T_scene_scan,
        center=votes.center,
        object=np.zeros(4, int),
        instance=votes.instance,
    )
    assert agreement(T, votes)[0] == 4
    assert agreement(T, many)[0] == 1


def test_symmetric_objects_agree_by_their_place_alone():
    """Round tables whose turn says nothing: their means alone pin the frame down."""
    rng = np.random.default_rng(2)
    T = pose(rng)
    center = rng.uniform(-3, 3, (4, 3))
    ways = []
    for c in center:
        about = np.eye(4)
        about[:3, :3] = Rotation.from_euler("z", rng.uniform(1, 5)).as_matrix()
        about[:3, 3] = c - about[:3, :3] @ c
        ways.append([T @ about])
    votes = Votes(T_scene_scan=np.array(ways), center=center, object=np.arange(4), instance=np.arange(4))
    found = estimate(noisy(T, center.mean(0), rng, 0.01, 0.5, "upright"), votes, "upright")
    assert found.agreeing == 4
    np.testing.assert_allclose(found.T_scene_scan, T, atol=1e-6)


@pytest.mark.parametrize("motion", ["upright", "free"])
def test_the_best_motion_of_exact_votes_is_exact_and_keeps_upright(motion):
    rng = np.random.default_rng(3)
    T = pose(rng, motion)
    votes = votes_for(T, rng, 3, 0, motion, 0.0, 0.0)
    ways, alike = votes.T_scene_scan[:, 0], np.ones(3, bool)
    found = best_motion(ways, votes.center, np.ones(3), alike, motion)
    np.testing.assert_allclose(found, T, atol=1e-9)
    alone = best_motion(ways[:1], votes.center[:1], np.ones(1), alike[:1], motion)  # by its turn
    np.testing.assert_allclose(alone, T, atol=1e-9)


def test_errors_of_the_frame_are_about_as_large_as_they_are_said_to_be():
    ratios = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        T = pose(rng)
        votes = votes_for(T, rng, 6, 2, sigma_m=0.01, sigma_deg=1.5)
        found = estimate(T, votes, "upright")
        ratios.append(off(found.T_scene_scan, T, votes) / position_sigma(found, apply_pose(T, votes.center)))
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 2.0


def test_backgrounds_fit_in_their_own_frame_and_are_silent_if_there_is_none():
    rng = np.random.default_rng(4)
    room = np.concatenate([rng.uniform(0, 1, (4000, 3)) * size for size in ([5, 4, 0], [5, 0, 2], [0, 4, 2])])
    T = pose(rng)
    other = apply_pose(np.linalg.inv(T), room + rng.normal(0, 0.005, room.shape))
    assert room_misfit(T, room, other) < 0.25
    assert room_misfit(EYE, room, other) > 0.7
    assert room_misfit(EYE, np.zeros((0, 3)), other) == 0.0
