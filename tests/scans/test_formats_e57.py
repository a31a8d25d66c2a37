"""E57: every scan moved by its pose, in one frame; colors where all scans have them; no instances."""

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("pye57")
from dataset_writers.e57 import write_e57

from more2_jax.scans.formats import e57
from more2_jax.scans.labeled_cloud import ReadOptions
from more2_jax.scans.read_scan import read_scan

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-2, 2, (300, 3)).astype(np.float32).astype(np.float64)  # pye57 writes single precision
QUATERNION = (0.5, -0.5, 0.5, 0.5)  # w first; no two orders of these are alike, and files hold them exactly
TURN = Rotation.from_quat([-0.5, 0.5, 0.5, 0.5])


def cloud(path):
    return e57.read(path, ReadOptions(masks_needed=False))


def test_scans_are_posed_and_merged_in_order(tmp_path):
    far = np.array([4e5, 5e6, 100.0])
    scans = [{"points": POINTS[:100]}, {"points": POINTS[100:], "rotation": QUATERNION, "translation": far}]
    found = cloud(write_e57(tmp_path / "a.e57", scans))
    np.testing.assert_allclose(found.points[:100], POINTS[:100], atol=1e-12)
    expected = (TURN.as_matrix() @ POINTS[100:].T).T + far
    np.testing.assert_allclose(found.points[100:], expected, rtol=0, atol=2e-9)
    np.testing.assert_allclose(found.sensors[-1], far)
    assert found.instance is None and found.colors is None and found.unit == "m"


def test_colors_need_every_scan_to_have_them(tmp_path):
    rgb = RNG.integers(0, 256, (300, 3)).astype(np.uint8)
    one = {"points": POINTS[:100], "colors": rgb[:100]}
    both = cloud(write_e57(tmp_path / "a.e57", [one, {"points": POINTS[100:], "colors": rgb[100:]}]))
    np.testing.assert_array_equal(both.colors, rgb)
    assert cloud(write_e57(tmp_path / "b.e57", [one, {"points": POINTS[100:]}])).colors is None


def test_points_marked_as_invalid_are_dropped_and_told(tmp_path):
    invalid = np.arange(300) % 3 == 0
    found = cloud(write_e57(tmp_path / "a.e57", [{"points": POINTS, "invalid": invalid}]))
    np.testing.assert_allclose(found.points, POINTS[~invalid], atol=1e-12)
    assert [(s.what, s.reason) for s in found.skipped] == [("100 points of scan 0", "marked as invalid")]


def test_spherical_coordinates():
    x, y, z = POINTS.T
    spherical = np.stack(
        [np.linalg.norm(POINTS, axis=1), np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))], axis=-1
    )
    np.testing.assert_allclose(e57._cartesian(spherical), POINTS, atol=1e-12)


def test_masks_make_instances_of_it(tmp_path):
    path = write_e57(tmp_path / "a.e57", [{"points": POINTS}])
    with pytest.raises(ValueError, match="no instance masks"):
        read_scan(path)
    np.savez(tmp_path / "m.npz", objectId=np.repeat([0, 5], [100, 200]))
    (instance,) = read_scan(path, masks=tmp_path / "m.npz").instances
    np.testing.assert_allclose(instance.points, POINTS[100:], atol=1e-12)


def test_damaged_files_are_refused_and_stay_where_they_are(tmp_path):
    whole = write_e57(tmp_path / "a.e57", [{"points": POINTS}]).read_bytes()
    for size in (0, 40, 1024, len(whole) - 1024):
        (tmp_path / "b.e57").write_bytes(whole[:size])
        with pytest.raises(ValueError, match="damaged E57"):
            read_scan(tmp_path / "b.e57")
        assert (tmp_path / "b.e57").exists()


def test_a_missing_library_names_the_extra(tmp_path, monkeypatch):
    path = write_e57(tmp_path / "a.e57", [{"points": POINTS}])
    monkeypatch.setitem(sys.modules, "pye57", None)
    with pytest.raises(ValueError, match=r"more2-jax\[formats\]"):
        read_scan(path)
