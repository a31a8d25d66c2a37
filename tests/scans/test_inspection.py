"""Inspection counts what is there and guesses unit and up axis from the floor."""

import numpy as np
import pytest

from more2_jax.geometry.up_axis import likely_up_axis
from more2_jax.scans.inspection import format_report, inspect_scan
from more2_jax.types import Instance, Scan, Skipped

RNG = np.random.default_rng(0)


def room(floor_points: int = 3000, unit: float = 1.0) -> Scan:
    """A 4 × 3 × 2.5 m room, z up: two boxes on a floor, one wall."""
    floor = RNG.uniform([0, 0, -0.01], [4, 3, 0.01], (floor_points, 3))
    wall = RNG.uniform([0, 0, 0], [0.02, 3, 2.5], (1000, 3))
    boxes = [
        RNG.uniform(low, high, (500, 3))
        for low, high in (([1, 1, 0], [1.5, 1.5, 1]), ([2, 2, 0], [3, 3, 0.8]))
    ]
    return Scan(
        name="room",
        source="room.ply",
        instances=(
            Instance(id=3, points=boxes[0] * unit, label="chair"),
            Instance(id=5, points=boxes[1] * unit),
        ),
        background=np.concatenate([floor, wall]) * unit,
        skipped=(Skipped(what="instance 9", reason="7 points; needed 64"),),
        warnings=("something odd",),
    )


AXES = {
    "+z": np.eye(3),
    "+y": np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "-y": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "+x": np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "-x": np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "-z": np.diag([1, -1, -1]),
}


@pytest.mark.parametrize("up", AXES)
@pytest.mark.parametrize("floor_points", [3000, 0])
def test_up_axis_turns_with_the_room(up, floor_points):
    scan = room(floor_points)
    background = [scan.background] if floor_points else []  # furniture alone is flattest along up
    points = np.concatenate([*(i.points for i in scan.instances), *background]) @ AXES[up].T
    assert likely_up_axis(points)[0] == up


@pytest.mark.parametrize("points", [np.zeros((50, 3)), RNG.uniform(size=(4000, 3)), np.ones((1, 3))])
def test_up_axis_is_unknown_where_nothing_shows_it(points):
    assert likely_up_axis(points)[0] is None


def test_up_axis_of_flat_and_straight_scans_does_not_fail():
    flat = RNG.uniform(size=(500, 3)) * [1, 1, 0]
    straight = RNG.uniform(size=(500, 3)) * [1, 0, 0]
    assert likely_up_axis(flat)[0] in ("+z", "-z")
    assert likely_up_axis(straight)[0] != "+x"


@pytest.mark.parametrize(("unit", "scale"), [("m", 1.0), ("cm", 100.0), ("mm", 1000.0)])
def test_likely_unit(unit, scale):
    assert inspect_scan(room(unit=scale)).likely_unit == unit


def test_report_counts_and_measures():
    scan = room()
    report = inspect_scan(scan)
    assert (report.points, report.background_points) == (5000, 4000)
    assert [(i.id, i.points, i.label) for i in report.instances] == [(3, 500, "chair"), (5, 500, None)]
    np.testing.assert_allclose(report.instances[0].extent, [0.5, 0.5, 1.0], atol=0.02)
    np.testing.assert_allclose(report.instances[1].center, [2.5, 2.5, 0.4], atol=0.02)
    np.testing.assert_allclose(report.extent, [4, 3, 2.5], atol=0.03)


def test_format_names_everything():
    text = format_report(inspect_scan(room()))
    for part in (
        "room.ply",
        "2 instances",
        "chair",
        "likely unit: m",
        "+z",
        "instance 9",
        "needed 64",
        "something odd",
    ):
        assert part in text
    quiet = inspect_scan(Scan(name="a", source="a", instances=room().instances))
    assert "ignored: nothing" in format_report(quiet)


def test_scan_without_instances_is_refused():
    with pytest.raises(ValueError, match="no instances"):
        inspect_scan(Scan(name="empty", source="", instances=()))
