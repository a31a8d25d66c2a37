"""Normals by sensors: out of the matter wherever they are known, and not known where sensors stand on both sides."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from more2_jax.scans.read_scan import read_scan
from more2_jax.scans.sensor_normals import FEWEST, seen_normals

IN_FRONT, BEHIND = np.array([0.5, 3.0, 0.5]), np.array([0.5, -3.0, 0.5])


def seen_box(rng, count=4000):
    """Points of a box that a sensor in front, above and to its left sees, and the true normals."""
    points = rng.uniform(0, 1, (count, 3))
    axis = rng.integers(0, 3, count)
    points[np.arange(count), axis] = np.array([0.0, 1.0, 1.0])[axis]
    return points, np.array([[-1.0, 0, 0], [0, 1, 0], [0, 0, 1]])[axis]


SENSOR = np.array([[-2.0, 3.0, 2.5]])


def away_from_edges(points):
    return (np.sort(np.minimum(points, 1 - points), axis=1)[:, 1]) > 0.12


def test_they_are_those_of_the_faces_that_were_seen():
    points, true = seen_box(np.random.default_rng(0))
    found = seen_normals(points, np.ones(len(points), int), SENSOR)
    inner = away_from_edges(points)
    assert inner.sum() > 1000
    assert np.quantile(np.sum(found * true, axis=1)[inner], 0.02) > 0.99
    assert (np.sum(found * true, axis=1) > -0.1).all()


def test_they_turn_with_the_scan_and_know_no_unit():
    points, _ = seen_box(np.random.default_rng(1), 500)
    one = np.ones(len(points), int)
    R = Rotation.from_rotvec([0.3, -0.9, 2.0]).as_matrix()
    here = seen_normals(points, one, SENSOR)
    there = seen_normals(1000 * (points @ R.T + 7.0), one, 1000 * (SENSOR @ R.T + 7.0))
    np.testing.assert_allclose(there, here @ R.T, atol=1e-6)


@pytest.mark.parametrize(
    ("sensors", "side"),
    [([IN_FRONT], 1), ([BEHIND], -1), ([IN_FRONT, IN_FRONT + 0.3], 1), ([IN_FRONT, BEHIND], 0)],
)
def test_a_board_has_the_side_that_all_sensors_stand_on(sensors, side):
    rng = np.random.default_rng(2)
    board = np.stack([rng.uniform(0, 1, 300), np.zeros(300), rng.uniform(0, 1, 300)], axis=1)
    found = seen_normals(board, np.full(300, 3), np.array(sensors))
    np.testing.assert_allclose(found, np.broadcast_to([0, side, 0], board.shape), atol=1e-9)


def test_background_and_what_has_hardly_a_point_have_none():
    points, _ = seen_box(np.random.default_rng(3), 300)
    instance = np.zeros(300, int)
    instance[: FEWEST - 1], instance[FEWEST : 2 * FEWEST] = 1, 2
    known = (seen_normals(points, instance, SENSOR) != 0).any(axis=1)
    assert known[instance == 2].all() and not known[instance != 2].any()


def test_a_file_with_sensors_and_without_normals_gets_them(tmp_path):
    points, true = seen_box(np.random.default_rng(4), 600)
    rows = {"points": points * 100, "instance": np.ones(len(points), np.int32)}
    np.savez(tmp_path / "a.npz", **rows, sensors=SENSOR * 100)
    np.savez(tmp_path / "b.npz", **rows)
    with_sensors, without = (read_scan(tmp_path / n, unit="cm").instances[0] for n in ("a.npz", "b.npz"))
    inner = away_from_edges(points)
    assert np.median(np.sum(with_sensors.normals * true, axis=1)[inner]) > 0.99
    assert without.normals is None
