"""Which places a scan shows to be empty: nothing near, and something well below."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from more2_jax.geometry.poses import apply_pose
from more2_jax.geometry.seen_space import BELOW_M, BLOCK, BLOCKS_KEPT, CELL_M, SeenSpace


def floor(side=3.0, step=0.05):
    """Points of a floor at z = 0."""
    x = np.arange(0, side, step) + 0.01
    return np.stack([*np.meshgrid(x, x), np.zeros((len(x), len(x)))], axis=-1).reshape(-1, 3)


def test_air_over_a_floor_is_empty_and_what_is_near_a_point_is_not():
    space = SeenSpace([floor()])
    places = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 0.05], [1.0, 1.0, -0.5]])
    assert space.empty(places, 0.08).tolist() == [True, False, False]  # beneath the floor nothing was seen


def test_a_place_that_the_scan_did_not_look_at_is_not_empty():
    seen = floor()
    seen = seen[(seen[:, 0] < 1.0) | (seen[:, 0] > 2.0)]  # the scan skipped a strip
    space = SeenSpace([seen])
    assert space.empty(np.array([[0.5, 1.5, 1.0], [1.5, 1.5, 1.0], [9.0, 1.5, 1.0]]), 0.08).tolist() == [
        True,
        False,
        False,
    ]


def test_a_box_on_the_floor_fills_its_surface_and_hides_nothing_else():
    rng = np.random.default_rng(0)
    box = rng.uniform(0, 0.5, (4000, 3))
    box[np.arange(4000), rng.integers(0, 3, 4000)] = rng.choice([0.0, 0.5], 4000)
    space = SeenSpace([np.concatenate([floor(), box + [1.0, 1.0, 0.0]])])
    on_it, beside = (
        np.array([[1.25, 1.25, 0.5], [1.0, 1.2, 0.3]]),
        np.array([[2.5, 2.5, 0.5], [0.3, 0.3, 0.3]]),
    )
    assert not space.empty(on_it, 0.08).any()
    assert space.empty(beside, 0.08).all()


def test_by_definition():
    """Against every point and every column by hand."""
    rng = np.random.default_rng(1)
    points, places = rng.uniform(-1, 1, (300, 3)), rng.uniform(-1.2, 1.2, (200, 3))
    reach = 0.2
    near = np.linalg.norm(points[None] - places[:, None], axis=-1).min(axis=1) < reach
    same = (np.floor(points[None, :, :2] / CELL_M) == np.floor(places[:, None, :2] / CELL_M)).all(axis=-1)
    below = (same & (points[None, :, 2] < places[:, None, 2] - BELOW_M)).any(axis=1)
    np.testing.assert_array_equal(SeenSpace([points]).empty(places, reach), ~near & below)
    assert 0 < (~near & below).sum() < 200


def test_the_order_of_points_and_shifts_by_whole_columns_change_nothing():
    rng = np.random.default_rng(2)
    points, places = rng.uniform(-1, 1, (300, 3)), rng.uniform(-1, 1, (200, 3))
    expected = SeenSpace([points]).empty(places, 0.2)
    np.testing.assert_array_equal(SeenSpace([rng.permutation(points)]).empty(places, 0.2), expected)
    T = np.eye(4)
    T[:3, 3] = [32 * CELL_M, -64 * CELL_M, 7.0]
    moved = SeenSpace([apply_pose(T, points)]).empty(apply_pose(T, places), 0.2)
    assert (moved == expected).mean() > 0.99  # rounding at the borders of columns


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.zeros((1, 3))])
def test_a_scan_of_next_to_nothing(points):
    empty = SeenSpace([points]).empty(np.array([[0.01, 0.01, 1.0]]), 0.08)
    assert empty.tolist() == [len(points) > 0]


def test_a_building_is_asked_block_by_block_as_if_it_were_one():
    """Many clouds over more blocks than are kept, places at their borders among them, asked in any order."""
    rng = np.random.default_rng(3)
    side = CELL_M * BLOCK
    shifts = [[i * side, j * side, 0.0] for i in range(-3, 3) for j in range(-3, 2)]
    assert len(shifts) > BLOCKS_KEPT
    clouds = [rng.uniform(-1.5, 1.5, (400, 3)) + s for s in shifts]
    places = np.concatenate([rng.uniform(-1.5, 1.5, (40, 3)) + s for s in shifts])
    points, reach = np.concatenate(clouds), 0.3
    near = np.isfinite(KDTree(points).query(places, distance_upper_bound=reach)[0])
    columns, own = (np.floor(p[:, :2] / CELL_M) for p in (points, places))
    lower = points[None, :, 2] < places[:, None, 2] - BELOW_M
    below = ((columns[None] == own[:, None]).all(axis=-1) & lower).any(axis=1)
    space = SeenSpace([np.zeros((0, 3)), *clouds])
    for order in (np.arange(len(places)), rng.permutation(len(places))):
        np.testing.assert_array_equal(space.empty(places[order], reach), (~near & below)[order])
    assert 20 < (~near & below).sum() < len(places) - 20


def test_a_reach_beyond_what_lies_beside_a_block_is_refused():
    with pytest.raises(ValueError, match=r"got a reach of 0\.5 m; needed 0\.3 at most"):
        SeenSpace([floor()]).empty(np.zeros((1, 3)), 0.5)
