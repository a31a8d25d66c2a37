"""Geometric segmentation: boxes on a floor come apart, whatever the order and frame of the points."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from more2_jax.data.scans import read_scan
from more2_jax.data.segmentation import SegmentationConfig, segment_geometric

CONFIG = SegmentationConfig()


def rectangle(low, high, n: int, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(low, high, (n, 3))


def box(center, side: float, rng: np.random.Generator) -> np.ndarray:
    p = rng.uniform(-0.5, 0.5, (6000, 3))
    p[np.arange(6000), rng.integers(0, 3, 6000)] = rng.choice([-0.5, 0.5], 6000)
    return p * side + center


def room(*objects: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A floor of 3 × 3 m and a wall, then objects numbered from 1."""
    rng = np.random.default_rng(0)
    floor = rectangle([0, 0, 0], [3, 3, 0], 30_000, rng)
    wall = rectangle([0, 0, 0], [0, 3, 2], 20_000, rng)
    parts = [np.concatenate([floor, wall]), *objects]
    return np.concatenate(parts), np.repeat(np.arange(len(parts)), [len(p) for p in parts])


def two_boxes() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    return room(box([1, 1, 0.36], 0.7, rng), box([2.2, 2.0, 0.31], 0.6, rng))


def agreement(found: np.ndarray, truth: np.ndarray) -> float:
    """Least over true objects of the best intersection over union."""
    return min(
        max(
            ((found == f) & (truth == t)).sum() / ((found == f) | (truth == t)).sum()
            for f in set(found) - {0}
        )
        for t in set(truth) - {0}
    )


def test_two_boxes_on_a_floor_are_two_instances():
    points, truth = two_boxes()
    found = segment_geometric(points, CONFIG)
    assert found.instance.max() == 2
    assert agreement(found.instance, truth) > 0.75
    assert (found.instance[truth == 0] == 0).mean() > 0.98
    assert sum(p.structure for p in found.planes) == 2


def test_order_of_points_does_not_matter():
    points, _ = two_boxes()
    order = np.random.default_rng(2).permutation(len(points))
    plain = segment_geometric(points, CONFIG).instance
    assert (segment_geometric(points[order], CONFIG).instance == plain[order]).mean() > 0.999


@pytest.mark.parametrize("turn", [Rotation.from_euler("z", 0.5), Rotation.from_euler("x", np.pi / 2)])
def test_the_frame_does_not_matter(turn: Rotation):
    points, truth = two_boxes()
    found = segment_geometric(turn.apply(points) + [3, -2, 1], CONFIG).instance
    assert found.max() == 2
    assert agreement(found, truth) > 0.75


def test_a_table_top_over_a_floor_stays():
    rng = np.random.default_rng(3)
    top = rectangle([1, 1, 0.7], [2.4, 2.0, 0.72], 15_000, rng)
    legs = [rectangle([x, y, 0], [x + 0.05, y + 0.05, 0.7], 1500, rng) for x in (1, 2.3) for y in (1, 1.9)]
    points, truth = room(np.concatenate([top, *legs]))
    found = segment_geometric(points, CONFIG)
    of_top = found.instance[(truth == 1) & (points[:, 2] > 0.69)]
    assert (of_top == 1).mean() > 0.95
    assert any(not p.structure for p in found.planes)


def test_nothing_but_planes_and_nothing_at_all(tmp_path):
    points, _ = room()
    for name, cloud in (("planes", points), ("empty", points[:0])):
        np.savez(tmp_path / f"{name}.npz", points=cloud)
        with pytest.raises(ValueError, match="no instances left"):
            read_scan(tmp_path / f"{name}.npz", segment="geometric")
    assert not segment_geometric(np.ones((1, 3)), CONFIG).instance.any()
    assert not segment_geometric(np.ones((500, 3)), CONFIG).instance.any()


def test_a_cloud_too_wide_is_refused():
    with pytest.raises(ValueError, match="measures"):
        segment_geometric(np.array([[0.0, 0, 0], [1e9, 0, 0]]), CONFIG)


def test_the_scan_says_what_was_done_and_that_masks_are_better(tmp_path):
    np.savez(tmp_path / "a.npz", points=two_boxes()[0])
    scan = read_scan(tmp_path / "a.npz", segment="geometric")
    assert len(scan.instances) == 2
    assert any("--masks" in w for w in scan.warnings)
    assert any("removed as floor or wall" in w for w in scan.warnings)
