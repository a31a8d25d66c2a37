"""`3RScan.json`: poses are checked by moving points by hand; what cannot be used is reported."""

import json

import numpy as np
import pytest
from dataset_writers.threerscan import column_major
from scipy.spatial.transform import Rotation

from eval.data.threerscan_index import CATEGORIES, read_index


def pose(turn_deg, shift):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
    T[:3, 3] = shift
    return T


T_REF_RESCAN = pose(30, [1.0, -2.0, 0.1])
T_RESCAN_REF_CHAIR = pose(-75, [0.4, 0.9, 0.0])  # reference → rescan, as the file has it


def place(scale=1.0, **changes):
    def numbers(T):
        T = T.copy()
        T[:3, 3] *= scale
        return column_major(T)

    rescan = {
        "reference": "b",
        "transform": numbers(T_REF_RESCAN),
        "nonrigid": [9, {"instance_reference": 12, "instance_rescan": 12, "symmetry": 0}],
        "removed": [5, "6"],
        "rigid": [
            {
                "instance_reference": "35",
                "instance_rescan": 36,
                "symmetry": 1,
                "transform": numbers(T_RESCAN_REF_CHAIR),
            }
        ],
    }
    chain = [
        {"instance_source": 1, "instance_target": 2, "transform": numbers(pose(90, [1.0, 0, 0]))},
        {"instance_source": 3, "instance_target": "2", "transform": numbers(pose(0, [0, 5.0, 0]))},
    ]
    return {"reference": "a", "type": "train", "ambiguity": [chain], "scans": [rescan | changes]}


def write(tmp_path, *places):
    file = tmp_path / "3RScan.json"
    file.write_text(json.dumps(places))
    return file


@pytest.mark.parametrize("scale", [1.0, 1000.0])  # meters; the first release, millimeters
def test_poses_take_the_rescan_to_the_reference(tmp_path, scale):
    (found,) = read_index(write(tmp_path, place(scale))).places
    (rescan,) = found.rescans
    assert (found.reference, found.split, rescan.id) == ("a", "train", "b")
    corner_rescan = np.array([0.5, 0.25, 1.0])
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    by_hand = [c * 0.5 - s * 0.25 + 1.0, s * 0.5 + c * 0.25 - 2.0, 1.1]
    np.testing.assert_allclose((rescan.T_ref_rescan @ [*corner_rescan, 1])[:3], by_hand)
    (chair,) = rescan.moved
    assert (chair.instance_ref, chair.instance_rescan, chair.symmetry) == (35, 36, 1)
    in_reference = np.array([2.0, 0.5, 0.3])
    in_rescan = T_RESCAN_REF_CHAIR @ [*in_reference, 1]  # where the file says it went
    np.testing.assert_allclose((chair.T_ref_rescan @ in_rescan)[:3], in_reference, atol=1e-12)


def test_true_associations(tmp_path):
    (rescan,) = read_index(write(tmp_path, place())).places[0].rescans
    assert [rescan.instance_in_reference(i) for i in (36, 4)] == [35, 4]
    assert rescan.pose_of(36) is rescan.moved[0].T_ref_rescan
    assert rescan.pose_of(4) is rescan.T_ref_rescan
    assert rescan.removed == (5, 6) and rescan.nonrigid == (9, 12)


def test_ambiguity_follows_chains_both_ways(tmp_path):
    (found,) = read_index(write(tmp_path, place())).places
    alike = found.interchangeable(1)
    assert set(alike) == {1, 2, 3}
    # 1 → 2: a quarter turn and 1 m along x; 2 → 3: back along y
    np.testing.assert_allclose(alike[2] @ [1, 0, 0, 1], [1, 1, 0, 1], atol=1e-12)
    np.testing.assert_allclose(alike[3] @ [1, 0, 0, 1], [1, -4, 0, 1], atol=1e-12)
    np.testing.assert_allclose(found.interchangeable(3)[1] @ alike[3], np.eye(4), atol=1e-12)
    assert set(found.interchangeable(99)) == {99}


def test_missing_rescans_are_reported(tmp_path):
    hidden = {"reference": "t", "type": "test", "scans": [{"reference": "u"}]}
    twice = place()
    twice["scans"].append(twice["scans"][0] | {"reference": "c"})
    file = write(tmp_path, twice, hidden, place() | {"reference": "z"})
    for name in ("a", "b", "t", "u"):
        (tmp_path / name).mkdir()
    index = read_index(file, scans=tmp_path)
    assert [(p.reference, [r.id for r in p.rescans]) for p in index.places] == [("a", ["b"]), ("t", [])]
    assert {s.what: s.reason for s in index.skipped} == {
        "rescan c": "no such folder",
        "rescan u": "no transform to its reference",
        "reference z": "no such folder: its place is left out",
    }
    assert [p.reference for p in read_index(file, split="test").places] == ["t"]


def bad_matrix(**changes):
    row = place()
    return row | {"scans": [row["scans"][0] | changes]}


BAD = {
    "an object": ({}, "list of places"),
    "no reference": ([{"type": "train"}], "place 0: no reference"),
    "type": ([{"reference": "a", "type": "new"}], "type 'new'"),
    "scans": ([{"reference": "a", "type": "train", "scans": 3}], "scans is no list"),
    "short": ([bad_matrix(transform=[1, 2, 3])], "not 16 numbers"),
    "sheared": ([bad_matrix(transform=[1.0] * 16)], "no rigid motion"),
    "row-major": ([bad_matrix(transform=T_REF_RESCAN.ravel().tolist())], "no rigid motion"),
    "huge": ([bad_matrix(transform=[10**400] * 16)], "not 16 numbers"),
    "rigid": ([bad_matrix(rigid=[{"instance_reference": 1}])], "instance_rescan: got 'None'"),
    "removed": ([bad_matrix(removed=[[]])], "removed: got"),
    "ambiguity": ([place() | {"ambiguity": ["x"]}], "ambiguity 0: got str"),
}


@pytest.mark.parametrize("name", BAD)
def test_damage_is_one_line(tmp_path, name):
    content, message = BAD[name]
    file = tmp_path / "3RScan.json"
    file.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message) as error:
        read_index(file)
    assert "\n" not in str(error.value)


def test_a_split_that_is_none_is_refused(tmp_path):
    with pytest.raises(ValueError, match="needed one of train, validation, test"):
        read_index(write(tmp_path, place()), split="val")


def test_the_categories_are_the_23_of_the_benchmark():
    assert len(CATEGORIES) == len(set(CATEGORIES)) == 23
