"""How far surfaces of two scans lie apart that both show, and how near one surface then lies to itself."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from more2_jax.geometry.poses import Points, apply_pose
from more2_jax.tracking.rooms import Rooms
from more2_jax.tracking.scan_noise import FARTHEST_M, NEAR_M, NOISES, REACH_M, near_m, with_noise
from more2_jax.types import Frame

T = np.eye(4)
T[:3, :3] = Rotation.from_euler("z", 40, degrees=True).as_matrix()
T[:3, 3] = [3.0, -1.0, 0.2]


def room(seed: int, noise_m: float = 0.0, things: int = 0) -> Points:
    """Floor and two walls of 3 m, off their planes by so much; and boxes of points that stand in it."""
    rng = np.random.default_rng(seed)
    sides = []
    for axis in range(3):
        points = rng.uniform(0, 3, (6000, 3))
        points[:, axis] = rng.normal(0, noise_m, len(points))
        sides.append(points)
    sides += [rng.uniform(0, 0.6, (800, 3)) + [1.0 + k, 1.2, 0.5] for k in range(things)]
    return np.concatenate(sides)


def noise_of(scene: Points, scan: Points, frame: Frame | None = None) -> float:
    frame = frame or Frame(T_scene_scan=T)
    rooms = Rooms(scene=scene, scan=apply_pose(np.linalg.inv(T), scan))
    return with_noise(frame, rooms.scene_surfaces, rooms.scan).noise_m


@pytest.mark.parametrize("noise_m", [0.005, 0.01, 0.02, 0.035])
def test_it_is_the_standard_deviation_off_surfaces(noise_m):
    assert noise_of(room(0), room(1, noise_m)) == pytest.approx(noise_m, rel=0.15)


def test_what_drifts_counts_and_what_only_one_scan_shows_does_not():
    shifted = room(1) + [0.0, 0.0, 0.02]
    assert noise_of(room(0), shifted) < 0.021  # two of three sides slid along themselves
    floors = room(0)[:, 2] < 0.01
    assert noise_of(room(0)[floors], shifted[shifted[:, 2] < 0.03]) == pytest.approx(0.02, abs=0.004)
    usual, crowded = (noise_of(room(0, things=k), room(1, 0.01, things=2 - k)) for k in (0, 2))
    assert usual == pytest.approx(crowded, abs=0.003) == pytest.approx(0.01, abs=0.004)


@pytest.mark.parametrize(
    ("scene", "scan", "frame"),
    [
        (room(0), room(1), Frame(T_scene_scan=T, unknown=True)),
        (room(0)[:100], room(1), None),
        (room(0), room(1)[:100], None),
        (room(0), room(1)[:0], None),
        (room(0), room(1) + [0, 0, 10.0], None),
        (np.concatenate([room(0), [[1e5, 0, 0]]]), room(1), None),  # too wide to be a room
    ],
    ids=["unknown frame", "no room", "no scan", "nothing", "elsewhere", "astray"],
)
def test_where_it_cannot_be_told_it_is_none(scene, scan, frame):
    assert noise_of(scene, scan, frame) == 0.0


def test_near_is_never_nearer_than_usual_and_grows_with_noise():
    assert near_m(0.0) == near_m(0.01) == NEAR_M
    assert near_m(0.025) == pytest.approx(NOISES * 0.025)
    assert near_m(REACH_M) == FARTHEST_M
