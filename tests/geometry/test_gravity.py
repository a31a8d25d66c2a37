"""Up by a room's levels: what it is by construction, whatever else is in the room, wherever the room lies."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from more2_jax.geometry.gravity import gravity, least_turn, stand_on_floor
from more2_jax.geometry.poses import apply_pose

NOTHING = np.zeros((0, 3))
X_M, Y_M, Z_M = 6.0, 4.0, 2.5


def box(rng: np.random.Generator, count: int, low: tuple, high: tuple) -> np.ndarray:
    return rng.uniform(low, high, (count, 3))


def walls(rng, count: int, height_m: float = Z_M) -> np.ndarray:
    sides = [
        ((0, 0, 0), (0, Y_M, height_m)),
        ((X_M, 0, 0), (X_M, Y_M, height_m)),
        ((0, 0, 0), (X_M, 0, height_m)),
    ]
    return np.concatenate([box(rng, count // 3, low, high) for low, high in sides])


def floor(rng, count: int, height_m: float = 0.0) -> np.ndarray:
    return box(rng, count, (0, 0, height_m), (X_M, Y_M, height_m))


def clutter(rng, count: int) -> np.ndarray:
    return box(rng, count, (1, 1, 0), (4, 3, 1.2))


def room(kind: str, seed: int = 0) -> np.ndarray:
    """A background whose z is up exactly, with 1 cm of noise."""
    rng = np.random.default_rng(seed)
    plain = [floor(rng, 3000), walls(rng, 4500), clutter(rng, 1500)]
    parts = {
        "plain": plain,
        "no walls": [floor(rng, 2000)],
        "walls dominate": [floor(rng, 1200), walls(rng, 12000)],
        "ceiling and tables": [
            floor(rng, 800),
            floor(rng, 800, Z_M),
            box(rng, 500, (1, 1, 0.75), (2.6, 1.8, 0.75)),
            walls(rng, 4500),
        ],
        "two floors": [
            box(rng, 1500, (0, 0, 0), (3, Y_M, 0)),
            box(rng, 1500, (3, 0, 0.4), (X_M, Y_M, 0.4)),
            walls(rng, 3000),
        ],
        "stairs": [
            box(rng, 1500, (0, 0, 0), (3, Y_M, 0)),
            *[
                box(rng, 150, (3 + 0.3 * k, 0, 0.18 * (k + 1)), (3.3 + 0.3 * k, 1, 0.18 * (k + 1)))
                for k in range(9)
            ],
            walls(rng, 3000),
        ],
        "a ramp": [*plain, slope(rng, 1500, 6.0)],
        "a sloping ceiling": [*plain, slope(rng, 4000, 35.0)],
        "a corridor": [p * [1.3, 0.3, 1.0] for p in plain],
        "a hall": [p * [3.5, 3.5, 1.2] for p in plain],
        "strays": [*plain, rng.normal(0, 1e8, (500, 3)), np.array([[0, 0, -1e9], [1e9, 0, 0]])],
    }
    points = np.concatenate(parts[kind])
    return points + rng.normal(0, 0.01, points.shape)


def slope(rng, count: int, angle_deg: float) -> np.ndarray:
    plane = box(rng, count, (0, -2, 0), (4, 0, 0))
    plane[:, 2] = plane[:, 0] * np.tan(np.deg2rad(angle_deg))
    return plane


def tilted(points: np.ndarray, tilt_deg: float, about_deg: float = 30.0) -> tuple[np.ndarray, np.ndarray]:
    """The points turned about a level axis, away from zero; and their up."""
    axis = [np.cos(np.deg2rad(about_deg)), np.sin(np.deg2rad(about_deg)), 0.0]
    R = Rotation.from_rotvec(tilt_deg * np.array(axis), degrees=True).as_matrix()
    return points @ R.T + [40.0, -70.0, 3.0], R[:, 2]


def off_deg(up: np.ndarray, true: np.ndarray) -> float:
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(up, true)), up @ true)))


KINDS = (
    "plain",
    "no walls",
    "walls dominate",
    "ceiling and tables",
    "two floors",
    "stairs",
    "a ramp",
    "a sloping ceiling",
    "a corridor",
    "a hall",
    "strays",
)


@pytest.mark.parametrize("tilt_deg", [0.0, 3.0, 8.0])
@pytest.mark.parametrize("kind", KINDS)
def test_up_is_found_in_rooms_of_many_kinds(kind, tilt_deg):
    points, up = tilted(room(kind), tilt_deg, about_deg=100 * len(kind))
    found = gravity(points)
    assert found is not None
    assert np.linalg.norm(found.up) == pytest.approx(1.0, abs=1e-12)
    assert off_deg(found.up, up) < 0.3
    assert found.tilt_deg == pytest.approx(tilt_deg, abs=0.3)


def test_without_noise_up_is_exact():
    points, up = tilted(floor(np.random.default_rng(0), 3000), 5.0)
    found = gravity(points)
    assert found is not None
    assert off_deg(found.up, up) < 1e-5
    assert found.share == 1.0


def without_floor(seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        "nothing": NOTHING,
        "one point": np.zeros((1, 3)),
        "few points": floor(rng, 100),
        "one place": np.zeros((1000, 3)),
        "a line": box(rng, 1000, (0, 0, 0), (5, 0, 0)),
        "a narrow board": box(rng, 1000, (0, 0, 0), (5, 0.2, 0)),
        "walls alone": walls(rng, 6000),
        "low walls": walls(rng, 6000, 1.0),
        "clutter alone": clutter(rng, 4000),
        "a steep slope": slope(rng, 3000, 25.0),
    }


@pytest.mark.parametrize("tilt_deg", [0.0, 5.0])
@pytest.mark.parametrize("kind", list(without_floor(0)))
def test_where_no_level_is_seen_up_is_not_known(kind, tilt_deg):
    assert gravity(tilted(without_floor(1)[kind], tilt_deg)[0]) is None


@pytest.mark.parametrize("turn_deg", [30.0, 60.0])
def test_where_z_is_not_up_none_is_found(turn_deg):
    R = Rotation.from_euler("xy", [turn_deg, 20.0], degrees=True).as_matrix()
    assert gravity(room("plain") @ R.T) is None


def test_neither_order_nor_place_nor_a_turn_about_z_matters():
    points, _ = tilted(room("plain"), 4.0)
    found = gravity(points)
    shuffled = gravity(np.random.default_rng(0).permutation(points))
    shifted = gravity(points + [1000.0, -2000.0, 50.0])
    R = Rotation.from_euler("z", 77.0, degrees=True).as_matrix()
    turned = gravity(points @ R.T)
    assert found is not None and shuffled is not None and shifted is not None and turned is not None
    np.testing.assert_allclose(shuffled.up, found.up, atol=1e-3)  # 0.06°: other points are tried
    np.testing.assert_allclose(shifted.up, found.up, atol=1e-6)
    np.testing.assert_allclose(turned.up, R @ found.up, atol=1e-3)


def test_leveling_turns_up_to_z_by_the_least_turn_and_holds_a_point():
    points, _ = tilted(room("plain"), 6.0)
    found, about = gravity(points), np.array([41.0, -69.0, 3.5])
    assert found is not None
    T = found.level(about)
    np.testing.assert_allclose(T[:3, :3] @ found.up, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(apply_pose(T, about[None])[0], about, atol=1e-12)
    turn = Rotation.from_matrix(T[:3, :3])
    assert np.rad2deg(turn.magnitude()) == pytest.approx(found.tilt_deg)
    assert turn.as_rotvec()[2] == pytest.approx(0.0, abs=1e-12)
    level = gravity(apply_pose(T, points))
    assert level is not None and level.tilt_deg < 0.02


def test_what_is_up_already_is_not_turned():
    np.testing.assert_array_equal(least_turn(np.array([0.0, 0.0, 1.0])), np.eye(3))


@pytest.mark.parametrize(("seed", "pieces"), [(2, 4), (4, 6), (6, 6), (6, 8), (11, 6)])
def test_ends_of_furniture_without_a_floor_tilt_nothing(seed, pieces):
    """What masks lost of a few pieces is all the background there is: ends of upright sides, at many heights."""
    rng, parts = np.random.default_rng(seed), []
    for _ in range(pieces):
        size = rng.uniform([0.4, 0.3, 0.4], [1.8, 0.9, 1.6])
        points = rng.uniform(-0.5, 0.5, (1500, 3))
        points[:, rng.integers(0, 2)] = rng.choice([-0.5, 0.5], 1500)
        out = np.linalg.norm(points * size, axis=1)
        points = points[out > np.quantile(out, 0.6 if pieces == 4 else 0.8)]
        turn = Rotation.from_rotvec([0, 0, rng.uniform(0, np.pi)]).as_matrix()
        parts.append(((points + [0, 0, 0.5]) * size) @ turn.T + rng.uniform([0, 0, 0], [5, 4, 0]))
    found = gravity(np.concatenate(parts))
    assert found is None or found.tilt_deg < 0.5


@pytest.mark.parametrize("seed", range(4))
def test_a_rough_floor_is_one_and_table_tops_alone_are_none(seed):
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([np.deg2rad(3.0), 0, 0]).as_matrix()
    rough = floor(rng, 4000) + [0.0, 0.0, 0.018] * rng.normal(size=(4000, 3))
    found = gravity(apply_pose(T, np.concatenate([rough, walls(rng, 3000), clutter(rng, 1000)])))
    assert found is not None and found.tilt_deg == pytest.approx(3.0, abs=0.5)
    top, below = box(rng, 3000, (1, 1, 0.75), (4, 3, 0.75)), box(rng, 1500, (1, 1, 0), (4, 3, 0.7))
    above = box(rng, 1500, (1, 1, 0.8), (4, 3, 1.6))
    assert gravity(apply_pose(T, np.concatenate([top, below, above]))) is None


UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("kind", ["plain", "no walls", "walls dominate", "ceiling and tables"])
def test_a_room_stands_on_its_floor_and_not_on_its_ceiling(kind):
    points = room(kind)
    assert stand_on_floor(points, UP)
    if kind != "no walls":  # which alone says nothing of what is above
        assert not stand_on_floor(points[points[:, 2] > 0.1], UP)
    assert not stand_on_floor(apply_pose(np.diag([1.0, -1.0, -1.0, 1.0]), room("plain")), UP)


def test_what_lies_below_the_floor_must_be_little():
    points = room("plain")
    below = (
        points[: len(points) // 10] * [1.0, 1.0, 0.0]
        - [0.0, 0.0, 1.0] * np.linspace(0.2, 3.0, len(points) // 10)[:, None]
    )
    assert stand_on_floor(np.concatenate([points, below[::4]]), UP)
    assert not stand_on_floor(np.concatenate([points, below]), UP)


@pytest.mark.parametrize("bent_m", [0.0, 0.08, 0.12])
def test_a_floor_that_drift_bends_is_one_and_a_low_table_is_none(bent_m):
    rng = np.random.default_rng(0)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([np.deg2rad(3.0), 0, 0]).as_matrix()
    bent = floor(rng, 6000) + [0.0, 0.0, 0.012] * rng.normal(size=(6000, 3))
    corner = (bent[:, 0] > np.quantile(bent[:, 0], 0.7)) & (bent[:, 1] > np.quantile(bent[:, 1], 0.6))
    bent[corner, 2] -= bent_m
    scan = apply_pose(T, np.concatenate([bent, walls(rng, 3000)]))
    found = gravity(scan)
    assert found is not None and found.tilt_deg == pytest.approx(3.0, abs=1.0)
    assert stand_on_floor(scan, found.up)
    top, legs = box(rng, 3000, (1, 1, 0.3), (4, 3, 0.3)), box(rng, 1500, (1, 1, 0), (4, 3, 0.28))
    lamps = box(rng, 1500, (1, 1, 0.4), (4, 3, 1.2))
    assert gravity(apply_pose(T, np.concatenate([top, legs, lamps]))) is None
