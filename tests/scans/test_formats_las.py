"""LAS and LAZ: coordinates by scale and offset, an extra dimension names the instance, colors of 16 bits."""

import sys

import numpy as np
import pytest

pytest.importorskip("laspy")
from dataset_writers.las import write_las

from more2_jax.scans.read_scan import read_scan

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-2, 2, (500, 3))
IDS = np.repeat([0, 3, 7, -1], [100, 200, 150, 50]).astype(np.int32)


@pytest.mark.parametrize("suffix", ["las", "laz", "LAZ"])
def test_instances_read_back(tmp_path, suffix):
    rgb = RNG.integers(0, 65536, (500, 3)).astype(np.uint16)
    scan = read_scan(write_las(tmp_path / f"room.{suffix}", POINTS, rgb, instance=IDS))
    assert [i.id for i in scan.instances] == [3, 7]
    for instance in scan.instances:
        np.testing.assert_allclose(instance.points, POINTS[instance.id == IDS], atol=5.1e-5)
        np.testing.assert_array_equal(instance.colors, rgb[instance.id == IDS] // 256)
    assert len(scan.background) == 150


def test_far_coordinates_keep_the_files_precision(tmp_path):
    far = POINTS + [4e5, 5e6, 100]
    scan = read_scan(write_las(tmp_path / "a.las", far, offset=[4e5, 5e6, 0], instance=IDS))
    np.testing.assert_allclose(scan.instances[0].points, far[IDS == 3], rtol=0, atol=5.2e-5)


def test_eight_bit_colors_in_sixteen_stay(tmp_path):
    rgb = RNG.integers(0, 256, (500, 3)).astype(np.uint16)
    scan = read_scan(write_las(tmp_path / "a.laz", POINTS, rgb, instance=IDS))
    np.testing.assert_array_equal(scan.instances[0].colors, rgb[IDS == 3])


def test_any_integer_dimension_may_be_asked_for(tmp_path):
    path = write_las(
        tmp_path / "a.las", POINTS, piece=np.maximum(IDS, 0).astype(np.uint16), height=POINTS[:, 2]
    )
    assert [i.id for i in read_scan(path, instance_property="piece").instances] == [3, 7]
    with pytest.raises(ValueError, match=r"no integer dimension height; .*piece"):
        read_scan(path, instance_property="height")
    with pytest.raises(ValueError, match="no instance masks"):
        read_scan(path)


def test_label_beside_the_instance(tmp_path):
    path = write_las(
        tmp_path / "a.las", POINTS, instance=IDS, label=np.where(IDS == 3, 41, 5).astype(np.uint8)
    )
    assert [i.label for i in read_scan(path).instances] == ["41", "5"]


def test_empty_and_truncated_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match="no points"):
        read_scan(write_las(tmp_path / "empty.las", POINTS[:0], instance=IDS[:0]))
    whole = write_las(tmp_path / "a.laz", POINTS, instance=IDS).read_bytes()
    for size in (0, 3, 100, len(whole) // 2):
        (tmp_path / "b.laz").write_bytes(whole[:size])
        with pytest.raises(ValueError, match="damaged LAS"):
            read_scan(tmp_path / "b.laz")


def test_a_missing_library_names_the_extra(tmp_path, monkeypatch):
    path = write_las(tmp_path / "a.las", POINTS, instance=IDS)
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(ValueError, match=r"more2-jax\[formats\]"):
        read_scan(path)
