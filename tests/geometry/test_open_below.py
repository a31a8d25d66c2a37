"""What stands on legs hides little of the floor; what may be solid hides it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from more2_jax.geometry.open_below import footprint, most_seen_beneath, openness, share_seen_beneath
from more2_jax.geometry.poses import apply_pose


def plate(half_x, half_y, height, count=2000, seed=0):
    xy = np.random.default_rng(seed).uniform(-1, 1, (count, 2)) * [half_x, half_y]
    return np.column_stack([xy, np.full(count, height)])


def table(height=0.7):
    legs = [
        plate(0.02, 0.02, 0.0, 100, k) + [x, y, 0] for k, (x, y) in enumerate([(0.55, 0.35), (-0.55, -0.35)])
    ]
    for leg in legs:
        leg[:, 2] = np.linspace(0.02, height, len(leg))
    return np.concatenate([plate(0.6, 0.4, height), *legs])


def cabinet():
    """Its front and top, as seen from one side."""
    front = plate(0.6, 0.45, 0.0)[:, [0, 2, 1]] + [0, -0.4, 0.45]
    return np.concatenate([front, plate(0.6, 0.4, 0.9)])


def floor(hidden=(0.0, 0.0), spacing=0.03):
    x, y = np.meshgrid(*[np.arange(-2, 2, spacing)] * 2)
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    return points[(np.abs(points[:, :2]) > hidden).any(axis=1)]


def test_the_floor_is_seen_beneath_a_table_and_not_beneath_a_cabinet():
    assert share_seen_beneath(table(), floor()) == 1.0
    assert share_seen_beneath(cabinet(), floor(hidden=(0.6, 0.4))) < 0.35


def test_the_share_is_that_of_the_area():
    half_hidden = floor()
    half_hidden = half_hidden[half_hidden[:, 0] > 0.0]
    assert share_seen_beneath(table(), half_hidden) == pytest.approx(0.5, abs=0.06)


@pytest.mark.parametrize("spacing", [0.02, 0.045, 0.07])
def test_a_background_may_be_thinned(spacing):
    assert share_seen_beneath(table(), floor(spacing=spacing)) > 0.95
    assert share_seen_beneath(cabinet(), floor(hidden=(0.6, 0.4), spacing=spacing)) < 0.5


def test_neither_yaw_nor_place_matter():
    for seed in range(3):
        turn = Rotation.from_rotvec([0, 0, seed + 0.3]).as_matrix().T
        shift = [30.0, -4.0, 2.5]
        for points, background in ((table(), floor()), (cabinet(), floor(hidden=(0.6, 0.4)))):
            moved = share_seen_beneath(points @ turn + shift, background @ turn + shift)
            assert moved == pytest.approx(share_seen_beneath(points, background), abs=0.08)


def test_what_hangs_on_a_wall_may_be_solid():
    assert share_seen_beneath(cabinet() + [0, 0, 1.2], floor()) == 0.0


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        np.zeros((1, 3)),
        np.zeros((50, 3)),
        np.linspace([0, 0, 0], [1.0, 0.5, 1.0], 40),
        np.repeat([[0.0, 0, 0], [1, 1, 0]], 5, axis=0),
    ],
)
def test_points_on_a_line_have_no_footprint(points):
    assert len(footprint(points[:, :2])) == 0
    assert share_seen_beneath(points, floor()) == 0.0


def test_a_footprint_of_a_kilometer_has_no_more_columns_than_are_needed():
    corners = np.array([[0.0, 0, 0], [1000, 0, 0], [0, 1000, 0], [1000, 1000, 0]])
    assert 30_000 < len(footprint(corners[:, :2])) <= 40_000
    assert share_seen_beneath(corners, floor(spacing=0.1)) < 0.01


def test_without_a_background_nothing_is_known():
    for background in (np.zeros((0, 3)), np.zeros((1, 3)), floor() + [100.0, 0, 0]):
        assert share_seen_beneath(table(), background) == 0.0


def test_the_scan_that_shows_most_counts():
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0, 0, 1.0]).as_matrix(), [2.0, -1.0, 0.5]
    beneath = floor() @ T[:3, :3] - T[:3, 3] @ T[:3, :3]  # in that scan's frame
    np.testing.assert_allclose(apply_pose(T, beneath), floor(), atol=1e-12)
    hidden = floor(hidden=(0.6, 0.4))
    assert most_seen_beneath(table(), [np.eye(4), T], [hidden, beneath]) == 1.0
    assert most_seen_beneath(table(), [np.eye(4)], [hidden]) < 0.3
    assert most_seen_beneath(table(), [], []) == 0.0


def test_between_solid_and_open_it_is_gradual():
    np.testing.assert_allclose(
        [openness(x) for x in (0.0, 0.7, 0.75, 0.9, 0.95, 1.0)], [0, 0, 0.2, 0.8, 1, 1]
    )
