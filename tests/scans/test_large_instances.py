"""Instances of more points than the stages use are thinned where a scan is read: evenly, to real points, and said."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from more2_jax.scans.large_instances import MOST_POINTS, spread, thinned_instances
from more2_jax.scans.read_scan import read_scan
from more2_jax.types import Instance

RNG = np.random.default_rng(0)
BOARD = RNG.uniform(size=(60_000, 3)) * [1.2, 0.6, 0.0]
UNEVEN = np.r_[RNG.uniform(size=(58_000, 3)) * [0.1, 0.1, 0.0], BOARD[:2_000]]


@pytest.mark.parametrize(
    "points", [BOARD, UNEVEN, RNG.uniform(size=(60_000, 3))], ids=["board", "uneven", "solid"]
)
def test_rows_are_of_the_cloud_ascending_and_not_many_fewer_than_allowed(points):
    rows = spread(points, 1000)
    assert (np.diff(rows) > 0).all()
    assert rows[0] >= 0
    assert rows[-1] < len(points)
    assert 700 <= len(rows) <= 1000


@pytest.mark.parametrize("points", [BOARD, UNEVEN], ids=["board", "uneven"])
def test_no_point_is_far_from_one_that_stays(points):
    """A thousand points on a board of 0.72 m² are some 27 mm apart; the diagonal of such a cell is 38 mm."""
    kept = KDTree(points[spread(points, 1000)])
    assert kept.query(points)[0].max() < 0.045


def test_a_part_that_was_scanned_more_often_does_not_take_the_points_of_the_rest():
    kept = UNEVEN[spread(UNEVEN, 1000)]
    assert (
        (kept[:, 0] > 0.1) | (kept[:, 1] > 0.1)
    ).mean() > 0.9  # the dense corner is a seventieth of the board


@pytest.mark.parametrize("far", [1e3, 1e9, 1e12])
def test_a_stray_point_changes_little(far):
    rows = spread(np.r_[BOARD, [[far, 0.0, 0.0]]], 1000)
    assert 700 <= len(rows) <= 1000


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_the_rows_do_not_depend_on_the_unit(scale):
    assert np.array_equal(spread(BOARD * scale, 1000), spread(BOARD, 1000))


def test_duplicates_and_a_line_are_thinned_as_well():
    assert 1 <= len(spread(np.ones((5_000, 3)), 1000)) <= 1000
    line = np.linspace(0, 1, 5_000)[:, None] * [1.0, 0.0, 0.0]
    rows = spread(line, 1000)
    assert 700 <= len(rows) <= 1000
    assert np.diff(line[rows, 0]).max() < 0.004


def test_few_points_are_all_kept():
    assert np.array_equal(spread(BOARD[:1000], 1000), np.arange(1000))


def test_colors_and_normals_go_with_their_points():
    places = RNG.uniform(size=(2 * MOST_POINTS, 3)) * [1.2, 0.6, 0.0]
    large = Instance(id=1, points=places, colors=(places * 100).astype(np.uint8), normals=places)
    small = Instance(id=2, points=places[:100])
    (thin, same), (said,) = thinned_instances([large, small])
    assert len(thin.points) <= MOST_POINTS
    assert np.array_equal(thin.normals, thin.points)
    assert np.array_equal(thin.colors, (thin.points * 100).astype(np.uint8))
    assert same is small
    assert said.startswith(f"1 instance has more than {MOST_POINTS} points, up to {2 * MOST_POINTS};")


def test_nothing_is_said_where_nothing_is_thinned():
    few = Instance(id=1, points=BOARD[:MOST_POINTS])
    assert thinned_instances([few]) == ((few,), ())


def test_the_reader_thins_and_says_so(tmp_path):
    points = np.r_[BOARD, BOARD[:500] + [3.0, 0.0, 0.0], BOARD + [0.0, 0.0, -1.0]]
    instance = np.repeat([1, 2, 0], [60_000, 500, 60_000])
    np.savez(tmp_path / "room.npz", points=points, instance=instance)
    scan = read_scan(tmp_path / "room.npz")
    assert [len(i.points) <= MOST_POINTS for i in scan.instances] == [True, True]
    assert len(scan.instances[1].points) == 500
    assert len(scan.background) == 60_000
    assert any(f"1 instance has more than {MOST_POINTS} points, up to 60000" in w for w in scan.warnings)
