"""Segmentation by changes: what moved is found in both scans, in any frame; what was not looked at is no change."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from more2_jax.geometry.segmentation import segment_geometric
from more2_jax.geometry.segmentation_config import SegmentationConfig
from more2_jax.scans.seen_empty import EMPTIED, STAYED, UNKNOWN, UnlabeledScan
from more2_jax.scans.temporal_segmentation import (
    ChangeConfig,
    moved_voxels,
    one_frame,
    segment_changes,
    together,
)

FLOOR_M = (4.0, 3.0)
STANDS, FROM, TO = (
    [0.8, 2.0, 0.5],
    [2.6, 0.8, 0.3],
    [3.2, 2.1, 0.3],
)  # a box that stays; places of one that moves


def panel(rng: np.random.Generator, low, high, per_m2: int = 1000) -> np.ndarray:
    """Points on a flat box, as many a square meter, 3 mm of noise."""
    size = np.sort(np.subtract(high, low))[1:]
    count = int(per_m2 * np.prod(size))
    return rng.uniform(low, high, (count, 3)) + rng.normal(0, 0.003, (count, 3))


def shell(rng: np.random.Generator) -> np.ndarray:
    """A floor and its walls, one with a pillar and one shorter than its opposite: no turn looks like another."""
    x, y = FLOOR_M
    walls = [([0, 0, 0], [0, y, 2]), ([x, 0, 0], [x, y, 1.5]), ([0, 0, 0], [x, 0, 2]), ([0, y, 0], [x, y, 2])]
    pillar = [([1.0, 0.25, 0], [1.5, 0.25, 2]), ([1.0, 0, 0], [1.0, 0.25, 2]), ([1.5, 0, 0], [1.5, 0.25, 2])]
    return np.concatenate([panel(rng, *p) for p in (([0, 0, 0], [x, y, 0]), *walls, *pillar)])


def box(rng: np.random.Generator, middle, size) -> np.ndarray:
    """All sides of a box but its bottom."""
    low, high = np.asarray(middle) - np.asarray(size) / 2, np.asarray(middle) + np.asarray(size) / 2
    sides = []
    for axis in range(3):
        for end in (low, high):
            if axis == 2 and end is low:
                continue
            a, b = low.copy(), high.copy()
            a[axis] = b[axis] = end[axis]
            sides.append(panel(rng, a, b))
    return np.concatenate(sides)


def visit(seed: int, *moving) -> tuple[UnlabeledScan, np.ndarray]:
    """A room with a box that stays (1) and boxes at other places (2, …); without what they hide of the floor."""
    rng = np.random.default_rng(seed)
    parts = [shell(rng), box(rng, STANDS, [0.9, 0.7, 1.0]), *(box(rng, m, [0.6, 0.5, 0.6]) for m in moving)]
    return joined(parts)


def joined(parts: list[np.ndarray]) -> tuple[UnlabeledScan, np.ndarray]:
    return UnlabeledScan(points=np.concatenate(parts)), np.repeat(
        np.arange(len(parts)), [len(p) for p in parts]
    )


def iou(of: np.ndarray, truth: np.ndarray) -> float:
    return (of & truth).sum() / (of | truth).sum()


def best(instance: np.ndarray, truth: np.ndarray) -> tuple[int, float]:
    """The instance that overlaps a mask most, and its intersection over union."""
    scores = [iou(instance == k, truth) for k in range(1, instance.max() + 1)]
    return int(np.argmax(scores)) + 1, max(scores)


def moved_by(scan: UnlabeledScan, turn: Rotation, shift) -> UnlabeledScan:
    return replace(scan, points=turn.apply(scan.points) + shift)


def test_identical_scans_have_no_change():
    """And are cut as each alone is."""
    scan, _ = visit(0, FROM)
    found = segment_changes([scan, scan])
    alone = segment_geometric(scan.points, SegmentationConfig()).instance
    assert alone.max() >= 2
    for f in found:
        assert not f.changed.any() and not f.emptied.any()
        assert (f.instance == alone).all()


def test_what_moved_is_found_in_both_scans_and_nothing_else_changed():
    (a, in_a), (b, in_b) = visit(0, FROM), visit(1, TO)
    for found, truth in zip(segment_changes([a, b]), (in_a, in_b), strict=True):
        for k, changed in ((1, False), (2, True)):
            which, overlap = best(found.instance, truth == k)
            assert overlap > 0.8
            assert found.changed[which - 1] == changed
        assert found.changed.sum() == 1


def test_what_came_is_cut_from_what_it_touches():
    """Alone, the scan shows one instance: a box pushed against another. The earlier scan parts them."""
    beside = [STANDS[0] + 0.45 + 0.3, STANDS[1], 0.3]
    (a, _), (b, in_b) = visit(0), visit(1, beside)
    alone = segment_geometric(b.points, SegmentationConfig()).instance
    assert best(alone, in_b == 2)[1] < 0.5
    found = segment_changes([a, b])[1]
    assert min(best(found.instance, in_b == k)[1] for k in (1, 2)) > 0.7
    assert found.changed[best(found.instance, in_b == 2)[0] - 1]
    assert not found.changed[best(found.instance, in_b == 1)[0] - 1]


def test_a_box_moved_by_less_than_its_width_stays_whole():
    """Half of its top lies where its top lay before: the cut does not run through it."""
    (a, in_a), (b, in_b) = visit(0, FROM), visit(1, [FROM[0] + 0.3, *FROM[1:]])
    for found, truth in zip(segment_changes([a, b]), (in_a, in_b), strict=True):
        assert best(found.instance, truth == 2)[1] > 0.8


def test_rigid_motion_of_all_scans_moves_the_answer_along():
    """No direction is taken for up where scans lie in one frame."""
    (a, in_a), (b, in_b) = visit(0, FROM), visit(1, TO)
    turn = Rotation.from_rotvec([1.0, 0.4, -0.7])
    for found, truth in zip(
        segment_changes([moved_by(s, turn, [3.0, -2.0, 5.0]) for s in (a, b)]), (in_a, in_b), strict=True
    ):
        which, overlap = best(found.instance, truth == 2)
        assert overlap > 0.8
        assert np.flatnonzero(found.changed).tolist() == [which - 1]


@pytest.mark.slow
def test_each_scan_may_lie_in_a_frame_of_its_own():
    """Turned about the vertical, tilted a little, meters apart: the pose is found, and the change as before."""
    (a, _), (b, in_b) = visit(0, FROM), visit(1, TO)
    turn = Rotation.from_euler("zx", [110.0, 3.0], degrees=True)
    found = segment_changes([a, moved_by(b, turn, [-7.0, 2.0, 1.0])])[1]
    assert (T := found.T_first_scan) is not None
    assert np.abs(T[:3, :3] @ turn.as_matrix() - np.eye(3)).max() < 0.01
    which, overlap = best(found.instance, in_b == 2)
    assert overlap > 0.8
    assert np.flatnonzero(found.changed).tolist() == [which - 1]


def test_what_one_scan_did_not_look_at_is_no_change():
    """The second scan ends before the box of the first: no floor there, nothing said of it."""
    (a, in_a), (b, _) = visit(0, FROM), visit(1)
    found = segment_changes([a, b])[0]
    assert found.changed[best(found.instance, in_a == 2)[0] - 1]
    seen = b.points[:, 0] < 1.8
    found = segment_changes([a, replace(b, points=b.points[seen])])[0]
    assert best(found.instance, in_a == 2)[1] > 0.8
    assert not found.changed.any()


@pytest.mark.slow
def test_order_of_points_and_of_scans_does_not_matter():
    (a, _), (b, _) = visit(0, FROM), visit(1, TO)
    order = np.random.default_rng(2).permutation(len(a.points))
    plain = segment_changes([a, b])
    mixed = segment_changes([replace(a, points=a.points[order]), b])
    assert (mixed[0].instance == plain[0].instance[order]).mean() > 0.999
    swapped = segment_changes([b, a])
    assert (swapped[1].instance == plain[0].instance).mean() > 0.99


@pytest.mark.slow
def test_three_scans_tell_more_than_two():
    """What was emptied in any scan has changed, though it stayed in another."""
    scans = [visit(0, FROM), visit(1, FROM), visit(2)]
    for found, (_, truth) in zip(segment_changes([s for s, _ in scans[:2]]), scans[:2], strict=True):
        assert not found.changed[best(found.instance, truth == 2)[0] - 1]
    for found, (_, truth) in zip(segment_changes([s for s, _ in scans])[:2], scans[:2], strict=True):
        assert found.changed[best(found.instance, truth == 2)[0] - 1]


def test_what_one_of_several_scans_shows_empty_counts_before_what_another_shows():
    said = [np.array(s, np.int8) for s in ([STAYED, STAYED, UNKNOWN], [EMPTIED, UNKNOWN, UNKNOWN])]
    assert together(said, 3).tolist() == together(said[::-1], 3).tolist() == [EMPTIED, STAYED, UNKNOWN]
    assert together([], 2).tolist() == [UNKNOWN, UNKNOWN]


def test_normals_and_sensors_may_be_given():
    """The room from within: the same change, whether normals are told or found."""
    (a, in_a), (b, _) = visit(0, FROM), visit(1, TO)
    inside = np.array([[2.0, 1.5, 1.4]])
    toward = [(inside - s.points) / np.linalg.norm(inside - s.points, axis=1, keepdims=True) for s in (a, b)]
    told = [replace(s, normals=n, sensors=inside) for s, n in zip((a, b), toward, strict=True)]
    found = segment_changes(told)[0]
    which, overlap = best(found.instance, in_a == 2)
    assert overlap > 0.8
    assert np.flatnonzero(found.changed).tolist() == [which - 1]


def test_the_cut_keeps_to_the_crease():
    """A box half seen empty on a slab that stayed: the whole box, nothing of the slab."""
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(20)), -1).reshape(-1, 2) * 0.03
    slab = np.concatenate([grid, np.zeros((400, 1))], axis=1)
    wall = np.stack([np.full(400, 0.6), grid[:, 0], grid[:, 1] + 0.03], axis=-1)
    points = np.concatenate([slab, wall])
    normals = np.repeat([[0.0, 0, 1], [-1.0, 0, 0]], 400, axis=0)
    state = np.repeat([STAYED, UNKNOWN], 400).astype(np.int8)
    state[400:][wall[:, 2] > 0.3] = EMPTIED
    moved = moved_voxels(points, normals, state, ChangeConfig())
    assert moved.tolist() == [False] * 400 + [True] * 400


def test_refuses_what_it_cannot_compare():
    a, _ = visit(0, FROM)
    with pytest.raises(ValueError, match=r"1 scans .* need two or more"):
        segment_changes([a])
    with pytest.raises(ValueError, match="none empty"):
        segment_changes([a, UnlabeledScan(points=np.zeros((0, 3)))])


def test_a_scan_that_lies_on_none_is_cut_alone():
    """And does not disturb those that lie on one another."""
    (a, _), (b, _) = visit(0, FROM), visit(1, TO)
    rng = np.random.default_rng(3)
    other = UnlabeledScan(
        points=np.concatenate([panel(rng, [0, 0, 0], [2, 2, 0]), box(rng, [1, 1, 0.4], [0.8] * 3)])
    )
    upside = moved_by(other, Rotation.from_euler("x", 180, degrees=True), [40.0, 0, 0])
    alone, *together = segment_changes([upside, a, b])
    assert alone.T_first_scan is None
    assert not alone.changed.any()
    assert "does not lie on the other scans" in alone.sentences()[0]
    geometric = segment_geometric(upside.points, SegmentationConfig()).instance
    np.testing.assert_array_equal(alone.instance > 0, geometric > 0)
    for found, as_two in zip(together, segment_changes([a, b]), strict=True):
        np.testing.assert_array_equal(found.instance, as_two.instance)


def test_scans_are_placed_by_any_that_is_placed():
    """Two halves that share nothing hang together by the whole."""
    whole, _ = visit(0, FROM)
    left, right = (
        replace(whole, points=whole.points[side])
        for side in (whole.points[:, 0] < 1.8, whole.points[:, 0] > 2.2)
    )
    placed = one_frame([left.points, right.points, whole.points])
    assert [first for first, _ in placed] == [0, 0, 0]
    assert all(np.abs(T - np.eye(4)).max() < 0.01 for _, T in placed)
