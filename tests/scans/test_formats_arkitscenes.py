"""Points in oriented boxes: the box's own frame decides, the smaller of two wins, empty boxes are told."""

import json

import numpy as np
import pytest
from dataset_writers.arkitscenes import box, write_arkitscenes
from scipy.spatial.transform import Rotation

from more2_jax.scans.read_scan import read_scan

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-2, 2, (4000, 3)).astype(np.float32).astype(np.float64)
AXES = Rotation.from_rotvec([0, 0, 0.6]).as_matrix().T  # rows are the axes: not its own transpose
TURNED = box("chair", [0.3, -0.2, 0.1], [2.0, 0.8, 1.6], AXES)


def corners_contain(row: dict) -> np.ndarray:
    """The box as the hull of its eight corners, as the data set draws it; which points lie in it."""
    aligned = row["segments"]["obbAligned"]
    axes = np.reshape(aligned["normalizedAxes"], (3, 3))
    half = np.array(aligned["axesLengths"]) / 2
    center = np.array(aligned["centroid"])
    inside = np.ones(len(POINTS), bool)
    for k in range(3):
        low, high = center - axes[k] * half[k], center + axes[k] * half[k]
        inside &= ((POINTS - low) @ axes[k] >= 0) & ((POINTS - high) @ axes[k] <= 0)
    return inside


@pytest.mark.parametrize("by", ["", "7_3dod_mesh.ply", "7_3dod_annotation.json"])
def test_points_in_a_turned_box_are_its_instance(tmp_path, by):
    scan = read_scan(write_arkitscenes(tmp_path / "7", POINTS, [TURNED]) / by)
    assert [(i.id, i.label) for i in scan.instances] == [(1, "chair")]
    np.testing.assert_array_equal(scan.instances[0].points, POINTS[corners_contain(TURNED)])
    assert scan.instances[0].colors is not None and scan.skipped == ()


@pytest.mark.parametrize("turn", [1, -1])
def test_overlapping_boxes_give_the_smaller_its_points(tmp_path, turn):
    small = box("pillow", [0.3, -0.2, 0.1], [0.8, 0.7, 0.9])
    scan = read_scan(write_arkitscenes(tmp_path / "7", POINTS, [TURNED, small][::turn]), min_points=1)
    found = {i.label: i.points for i in scan.instances}
    np.testing.assert_array_equal(found["pillow"], POINTS[corners_contain(small)])
    both = corners_contain(TURNED) & ~corners_contain(small)
    np.testing.assert_array_equal(found["chair"], POINTS[both])


def test_boxes_without_points_are_skipped_with_their_reason(tmp_path):
    rows = [
        TURNED,
        box("lamp", [50, 0, 0], [1, 1, 1]),
        TURNED | {"label": "twin"},
        box("flat", [0, 0, 0], [0, 0, 0]),
    ]
    scan = read_scan(write_arkitscenes(tmp_path / "7", POINTS, rows))
    assert [i.label for i in scan.instances] == ["chair"]
    said = {s.what: s.reason for s in scan.skipped}
    assert said == {
        "box 2 (lamp)": "no points inside",
        "box 3 (twin)": "all its points lie in smaller boxes",
        "box 4 (flat)": "no points inside",
    }


def test_no_boxes_at_all(tmp_path):
    with pytest.raises(ValueError, match="no instances left"):
        read_scan(write_arkitscenes(tmp_path / "7", POINTS, []))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"normalizedAxes": [1, 0, 0, 0, 1, 0, 0, 0, 2]}, "not orthonormal"),
        ({"axesLengths": [1, 2]}, "three numbers"),
        ({"axesLengths": [1, -2, 1]}, "negative"),
        ({"centroid": [0, 0, float("nan")]}, "not finite"),
        ({"centroid": None}, "box 1"),
        ({"normalizedAxes": "up"}, "box 1"),
    ],
)
def test_a_malformed_box_is_named(tmp_path, change, said):
    row = json.loads(json.dumps(TURNED))
    row["segments"]["obbAligned"] |= change
    with pytest.raises(ValueError, match=said):
        read_scan(write_arkitscenes(tmp_path / "7", POINTS, [row]))


def test_what_is_missing_beside_the_mesh_is_said(tmp_path):
    folder = write_arkitscenes(tmp_path / "7", POINTS, [TURNED])
    (folder / "7_3dod_annotation.json").unlink()
    with pytest.raises(ValueError, match=r"no 7_3dod_annotation\.json"):
        read_scan(folder)
    write_arkitscenes(tmp_path / "7", POINTS, [TURNED])
    (folder / "7_3dod_mesh.ply").rename(folder / "8_3dod_mesh.ply")
    with pytest.raises(ValueError, match=r"no 7_3dod_mesh\.ply"):
        read_scan(folder / "7_3dod_annotation.json")
