"""ScanNet and ScanNet++ read back a known cloud; ids, empty groups, shared segments and damage as documented."""

import json

import numpy as np
import pytest
from dataset_writers.scannet import write_scannet, write_scannetpp

from eval.data.threerscan_index import CATEGORIES
from more2_jax.scans.formats import scannetpp
from more2_jax.scans.labeled_cloud import ReadOptions
from more2_jax.scans.read_scan import read_scan
from more2_jax.scans.structural_labels import BACKGROUND_LABELS, is_background, normalized

RNG = np.random.default_rng(3)
POINTS = RNG.uniform(-2, 2, (600, 3)).astype("f4").astype(np.float64)
SEGMENTS = np.repeat([40, 7, 123456, 9, 2, 88], 100)  # 88 is in no group
GROUPS = [(0, "chair", [40]), (1, "table", [7, 2]), (2, "wall", [123456]), (5, "lamp", [9]), (6, "box", [])]


def check(scan, first=1):
    """The instances that GROUPS says, written out by hand."""
    wanted = {first: ("chair", [40]), first + 1: ("table", [7, 2]), first + 5: ("lamp", [9])}
    assert {i.id: i.label for i in scan.instances} == {i: label for i, (label, _) in wanted.items()}
    for instance in scan.instances:
        np.testing.assert_array_equal(instance.points, POINTS[np.isin(SEGMENTS, wanted[instance.id][1])])
    np.testing.assert_array_equal(scan.background, POINTS[np.isin(SEGMENTS, [123456, 88])])
    reasons = {s.what: s.reason for s in scan.skipped}
    assert set(reasons) == {f"instance {first + 2} (wall)", f"instance {first + 6} (box)"}
    assert "background" in reasons[f"instance {first + 2} (wall)"]


@pytest.mark.parametrize("strings", [False, True])
@pytest.mark.parametrize("by", ["folder", "mesh"])
def test_scannet_reads_back(tmp_path, strings, by):
    mesh = write_scannet(tmp_path / "scene0001_00", POINTS, SEGMENTS, GROUPS, strings=strings)
    check(read_scan(mesh if by == "mesh" else mesh.parent))


def test_scannetpp_reads_back_with_its_own_ids(tmp_path):
    groups = [(i + 1, label, segments) for i, label, segments in GROUPS]
    scene = write_scannetpp(tmp_path / "3db0a1c8f3", POINTS, SEGMENTS, groups)
    for path in (scene, scene / "scans", scene / "scans" / "mesh_aligned_0.05.ply"):
        scan = read_scan(path)
        check(scan)
        assert scan.warnings == ()


def test_scannetpp_that_counts_from_zero_loses_no_object(tmp_path):
    scan = read_scan(write_scannetpp(tmp_path / "3db0a1c8f3", POINTS, SEGMENTS, GROUPS))
    check(scan)
    assert any("from 0" in warning for warning in scan.warnings)


def test_a_shared_segment_is_of_the_later_group_and_a_repeated_id_is_one_instance(tmp_path):
    groups = [(0, "chair", [40, 7]), (1, "table", [7]), (0, "chair", [9])]
    scan = read_scan(write_scannet(tmp_path / "scene0217_00", POINTS, SEGMENTS, groups))
    assert [i.id for i in scan.instances] == [1, 2]
    np.testing.assert_array_equal(scan.instances[0].points, POINTS[np.isin(SEGMENTS, [40, 9])])
    np.testing.assert_array_equal(scan.instances[1].points, POINTS[SEGMENTS == 7])


def test_points_stay_in_the_mesh_frame_whatever_the_alignment(tmp_path):
    T = np.eye(4)
    T[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    T[:3, 3] = [1.0, 2.0, 3.0]
    mesh = write_scannet(tmp_path / "scene0002_00", POINTS, SEGMENTS, GROUPS, alignment=T)
    check(read_scan(mesh))


@pytest.mark.parametrize(
    ("missing", "message"),
    [
        (".aggregation.json", "aggregation.json beside it"),
        ("_vh_clean_2.0.010000.segs.json", "segs.json beside it"),
    ],
)
def test_a_missing_file_is_named(tmp_path, missing, message):
    mesh = write_scannet(tmp_path / "scene0001_00", POINTS, SEGMENTS, GROUPS)
    (mesh.parent / f"scene0001_00{missing}").unlink()
    with pytest.raises(ValueError, match=message):
        read_scan(mesh)


def test_a_scene_without_annotation_is_cut_and_one_with_it_is_not(tmp_path):
    """`segment` is for scans without masks: the annotation, where there is one, is kept."""
    seen = read_scan(write_scannet(tmp_path / "scene0001_00", POINTS, SEGMENTS, GROUPS), segment="geometric")
    assert [i.id for i in seen.instances] == [1, 2, 6]
    pp = write_scannetpp(tmp_path / "3db0a1c8f3", POINTS, SEGMENTS, GROUPS[:1])
    assert len(read_scan(pp, segment="geometric").instances) == 1
    options = ReadOptions(masks_needed=False)
    for name in ("segments.json", "segments_anno.json"):
        (pp / "scans" / name).unlink()
    cloud = scannetpp.read(pp, options)
    assert cloud.instance is None
    np.testing.assert_array_equal(cloud.points, POINTS)


DAMAGE = {
    "cut short": (lambda text: text[: len(text) // 2], "not readable JSON"),
    "deep": (lambda text: "[" * 100_000, "not readable JSON"),
    "no list": (lambda text: '{"segGroups": 3}', "no list 'segGroups'"),
    "a list": (lambda text: "[]", "no list 'segGroups'"),
    "null group": (lambda text: '{"segGroups": [null]}', r"segGroups\[0\]: got NoneType"),
    "no id": (lambda text: '{"segGroups": [{"label": "a"}]}', "no objectId or id"),
    "huge id": (lambda text: '{"segGroups": [{"id": 1e300, "segments": []}]}', "needed at most"),
    "negative": (lambda text: '{"segGroups": [{"id": -4, "segments": []}]}', "negative objectId"),
    "true": (lambda text: '{"segGroups": [{"id": true, "segments": []}]}', "needed a whole number"),
    "huge segment": (lambda text: '{"segGroups": [{"id": 1, "segments": [1' + "0" * 30 + "]}]}", "63 bits"),
    "label": (lambda text: '{"segGroups": [{"id": 1, "label": 4, "segments": [1]}]}', "label is '4'"),
    "not text": (lambda text: "\udcff", "not readable JSON"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_annotation_is_one_line(tmp_path, damage):
    change, message = DAMAGE[damage]
    mesh = write_scannet(tmp_path / "scene0001_00", POINTS, SEGMENTS, GROUPS)
    file = mesh.parent / "scene0001_00.aggregation.json"
    file.write_bytes(change(file.read_text()).encode("utf-8", "surrogateescape"))
    with pytest.raises(ValueError, match=message) as error:
        read_scan(mesh)
    assert "\n" not in str(error.value)


def test_segments_of_another_mesh_are_refused(tmp_path):
    mesh = write_scannet(tmp_path / "scene0001_00", POINTS, SEGMENTS, GROUPS)
    file = mesh.parent / "scene0001_00_vh_clean_2.0.010000.segs.json"
    file.write_text(json.dumps({"segIndices": [1] * 599}))
    with pytest.raises(ValueError, match="599 segIndices; needed 600"):
        read_scan(mesh)


def test_labels_of_the_room_and_of_no_object_are_background():
    for label in (
        "wall",
        "Floor",
        "ceiling",
        "door_frame",
        "Door-Frame",
        "window",
        "REMOVE",
        "unlabeled",
        "unlabelled",
    ):
        assert is_background(label), label
    assert not is_background(None)
    assert {normalized(label) for label in BACKGROUND_LABELS} == BACKGROUND_LABELS


def test_no_category_that_moves_is_background():
    for label in (
        *CATEGORIES,
        "wall hanging",
        "wall-cabinet",
        "floor lamp",
        "cabinet door handle",
        "window blind",
    ):
        assert not is_background(label), label
