"""Predicted masks over a cloud: the surer wins, what is dropped is told, every count must be the cloud's."""

import numpy as np
import pytest
from dataset_writers.masks import write_masks
from dataset_writers.ply_file import vertex_columns, write_ply

from more2_jax.scans.read_scan import read_scan

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-2, 2, (400, 3)).astype(np.float32).astype(np.float64)
MASKS = np.zeros((400, 4), bool)
MASKS[0:200, 0] = MASKS[150:300, 1] = MASKS[300:400, 2] = MASKS[160:190, 3] = True
CLASSES, SCORES = (2, 56, 7, 5), (0.6, 0.9, 0.2, 0.7)


@pytest.fixture
def scan(tmp_path):
    return write_ply(
        tmp_path / "scene0001_00_vh.ply", vertex_columns(POINTS)
    )  # no property names an instance


def expected_instances() -> dict[str, np.ndarray]:
    """By the definition: every point asks all masks scored 0.5 or more, and takes the surest."""
    found = {}
    for point, row in zip(POINTS, MASKS, strict=True):
        sure = [(SCORES[k], k) for k in range(4) if row[k] and SCORES[k] >= 0.5]
        if sure:
            found.setdefault(str(CLASSES[max(sure)[1]]), []).append(point)
    return {label: np.array(points) for label, points in found.items()}


@pytest.mark.parametrize("form", ["txt", "npz", "folder"])
def test_the_surest_mask_has_the_point(tmp_path, scan, form):
    masks = write_masks(tmp_path / "out" / "scene0001_00.txt", MASKS, CLASSES, SCORES)
    if form == "npz":
        masks = tmp_path / "m.npz"
        np.savez(masks, masks=MASKS, scores=np.array(SCORES), labels=np.array(CLASSES))
    read = read_scan(scan, masks=masks.parent if form == "folder" else masks)
    assert {i.label for i in read.instances} == set(expected_instances())
    for instance in read.instances:
        np.testing.assert_array_equal(instance.points, expected_instances()[instance.label])
    assert sorted(s.reason for s in read.skipped) == [
        "all its points lie under surer masks",
        "score 0.2; needed 0.5",
    ]


def test_min_score_is_the_callers(tmp_path, scan):
    masks = write_masks(tmp_path / "m.txt", MASKS, CLASSES, SCORES)
    assert len(read_scan(scan, masks=masks, min_score=0.1).instances) == 3
    with pytest.raises(ValueError, match="no instances left"):
        read_scan(scan, masks=masks, min_score=0.95)


def test_equal_scores_give_the_first(tmp_path, scan):
    masks = write_masks(tmp_path / "m.txt", MASKS[:, :2], ("a", "b"), (0.8, 0.8))
    assert [(i.label, len(i.points)) for i in read_scan(scan, masks=masks).instances] == [
        ("a", 200),
        ("b", 100),
    ]


def test_masks_replace_the_scans_own_instances(tmp_path):
    own = write_ply(
        tmp_path / "a.ply",
        vertex_columns(POINTS, instance=np.full(400, 9, np.int32), label=np.full(400, 4, np.int32)),
    )
    np.savez(tmp_path / "m.npz", objectId=np.repeat([0, 12], 200))
    assert [(i.id, i.label, len(i.points)) for i in read_scan(own, masks=tmp_path / "m.npz").instances] == [
        (12, None, 200)
    ]


def test_both_counts_are_said(tmp_path, scan):
    masks = write_masks(tmp_path / "m.txt", MASKS[:-1], CLASSES, SCORES)
    with pytest.raises(ValueError, match="399 numbers; the scan has 400 points"):
        read_scan(scan, masks=masks)
    np.savez(tmp_path / "m.npz", masks=MASKS.T)
    with pytest.raises(ValueError, match=r"shape \(4, 400\); needed \(400, instances\)"):
        read_scan(scan, masks=tmp_path / "m.npz")
    np.savez(tmp_path / "i.npz", objectId=np.ones(7, int))
    with pytest.raises(ValueError, match="7 points; the scan has 400"):
        read_scan(scan, masks=tmp_path / "i.npz")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("pred_mask/m_000.txt 2", "line 1 is not"),
        ("pred_mask/m_000.txt 2 high", "line 1 is not"),
        ("pred_mask/m_000.txt 2 nan", "finite"),
        ("../m_000.txt 2 0.5", "not below"),
        ("/m_000.txt 2 0.5", "not below"),
        ("pred_mask/none.txt 2 0.5", "not a readable file of numbers"),
        ("m.txt 2 0.5", "not a readable file of numbers"),
        ("pred_mask 2 0.5", "not a readable file of numbers"),
    ],
)
def test_a_malformed_line_is_named(tmp_path, scan, line, said):
    masks = write_masks(tmp_path / "m.txt", MASKS, CLASSES, SCORES)
    masks.write_text(line + "\n")
    with pytest.raises(ValueError, match=said):
        read_scan(scan, masks=masks)


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"other": MASKS}, "needed masks or objectId"),
        ({"masks": MASKS.astype(str)}, "booleans or numbers"),
        ({"masks": MASKS, "scores": np.ones(3)}, "4 finite"),
        ({"masks": MASKS, "labels": np.ones(4)}, "4 names or ids"),
        ({"objectId": np.ones(400)}, "needed integers"),
    ],
)
def test_malformed_arrays_are_named(tmp_path, scan, arrays, said):
    np.savez(tmp_path / "m.npz", **arrays)
    with pytest.raises(ValueError, match=said):
        read_scan(scan, masks=tmp_path / "m.npz")


def test_a_folder_must_have_the_scans_masks(tmp_path, scan):
    write_masks(
        tmp_path / "out" / "scene0001_001.txt", MASKS, CLASSES, SCORES
    )  # begins alike, but another scan
    with pytest.raises(ValueError, match="no masks of scan scene0001_00_vh"):
        read_scan(scan, masks=tmp_path / "out")
    with pytest.raises(ValueError, match="no such file"):
        read_scan(scan, masks=tmp_path / "none")


def test_names_from_a_file_cannot_break_the_line(tmp_path):
    path = write_ply(tmp_path / "a.ply", vertex_columns(POINTS, name=np.ones(400, np.int32)))
    path.write_bytes(path.read_bytes().replace(b"int name", b"int n\x1bme"))
    with pytest.raises(ValueError, match=r"integer properties are n\?me"):
        read_scan(path)
