"""PCD: what an independent writer wrote is read back; damage ends in one line."""

from pathlib import Path

import numpy as np
import pytest
from dataset_writers.masks import write_masks
from dataset_writers.pcd import lzf, write_pcd

from more2_jax.scans.formats import pcd
from more2_jax.scans.labeled_cloud import ReadOptions
from more2_jax.scans.read_scan import read_scan

ENCODINGS = ("ascii", "binary", "binary_compressed")
OPTIONS = ReadOptions()


def fields(n: int = 40) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    xyz = {axis: rng.normal(size=n).astype(np.float32) for axis in "xyz"}
    rgb = (rng.integers(1, 200, (n, 3)) @ [1 << 16, 1 << 8, 1]).astype(np.uint32)
    return {**xyz, "rgb": rgb, "label": np.arange(n, dtype=np.uint32) // 10}


@pytest.mark.parametrize("data", ENCODINGS)
@pytest.mark.parametrize("packed", [np.uint32, np.float32])
def test_reads_back(tmp_path: Path, data: str, packed: type):
    wrote = fields()
    bits = wrote["rgb"]
    cloud = pcd.read(write_pcd(tmp_path / "a.pcd", wrote | {"rgb": bits.view(packed)}, data), OPTIONS)
    np.testing.assert_array_equal(cloud.points, np.stack([wrote[a] for a in "xyz"], axis=-1))
    np.testing.assert_array_equal(cloud.instance, wrote["label"])
    assert cloud.colors is not None
    np.testing.assert_array_equal(cloud.colors @ [1 << 16, 1 << 8, 1], bits)
    assert cloud.warnings == ()


@pytest.mark.parametrize("data", ENCODINGS)
def test_points_without_depth_are_left_out_and_counted(tmp_path: Path, data: str):
    wrote = fields()
    wrote["x"][3:6] = np.nan
    cloud = pcd.read(write_pcd(tmp_path / "a.pcd", wrote, data, "0 0 0 0 1 0 0"), OPTIONS)
    np.testing.assert_array_equal(cloud.instance, np.delete(wrote["label"], [3, 4, 5]))
    assert cloud.warnings[0].startswith("3 of 40 points")
    assert "VIEWPOINT 0 0 0 0 1 0 0 is not applied" in cloud.warnings[1]


@pytest.mark.parametrize("form", ["npz", "per point", "txt"])
def test_masks_speak_of_the_rows_of_the_file(tmp_path: Path, form: str):
    wrote = {k: v for k, v in fields().items() if k in "xyz"}
    wrote["y"][[2, 5, 17, 30]] = np.nan
    path = write_pcd(tmp_path / "a.pcd", wrote, "binary")
    masks = np.zeros((40, 3), bool)
    masks[0:16, 0] = masks[16:36, 1] = masks[[2, 5], 2] = True  # the third covers no measured point
    if form == "txt":
        file = write_masks(tmp_path / "m.txt", masks, (1, 2, 3), (0.8, 0.7, 0.9))
    elif form == "npz":
        file = tmp_path / "m.npz"
        np.savez(file, masks=masks, scores=np.array([0.8, 0.7, 0.9]))
    else:
        file = tmp_path / "m.npz"
        np.savez(file, instance=masks @ [1, 2, 0])
    read = read_scan(path, masks=file, min_points=1)
    whole = np.stack([wrote[a] for a in "xyz"], axis=-1)
    for instance, column in zip(read.instances, (0, 1), strict=True):
        rows = masks[:, column] & np.isfinite(whole).all(axis=1)
        np.testing.assert_array_equal(instance.points, whole[rows])
    if form != "per point":
        assert [s.reason for s in read.skipped] == ["covers no point"]


def test_masks_of_the_measured_points_alone_are_refused(tmp_path: Path):
    wrote = {k: v for k, v in fields().items() if k in "xyz"}
    wrote["z"][:4] = np.nan
    path = write_pcd(tmp_path / "a.pcd", wrote, "binary")
    np.savez(tmp_path / "m.npz", instance=np.ones(36, int))
    with pytest.raises(ValueError, match="for 36 points; the scan has 40"):
        read_scan(path, masks=tmp_path / "m.npz", min_points=1)


def test_no_masks_are_said_or_welcome(tmp_path: Path):
    wrote = {k: v for k, v in fields().items() if k in "xyz"}
    path = write_pcd(tmp_path / "a.pcd", wrote, "binary")
    assert pcd.read(path, ReadOptions(masks_needed=False)).instance is None
    with pytest.raises(ValueError, match=r"--instance-property.*--segment geometric"):
        pcd.read(path, OPTIONS)


@pytest.mark.parametrize("plain", [b"", b"a", b"a" * 1000, b"abc" * 200, bytes(range(256)) * 50])
def test_lzf_round_trip(plain: bytes):
    assert pcd.decompressed(lzf(plain), len(plain)) == plain
    for size in (len(plain) - 1, len(plain) + 1):
        with pytest.raises(ValueError, match="yield"):
            pcd.decompressed(lzf(plain), size)


def test_lzf_promises_more_than_it_can_hold():
    with pytest.raises(ValueError, match="cannot yield"):
        pcd.decompressed(b"\x00a", 10**12)


@pytest.mark.parametrize("data", ENCODINGS)
def test_mutated_files_raise_one_line_or_read(tmp_path: Path, data: str):
    rng = np.random.default_rng(1)
    whole = write_pcd(tmp_path / "a.pcd", fields(), data).read_bytes()
    refused = []
    for _ in range(300):
        damaged = bytearray(whole[: rng.integers(1, len(whole) + 1)])
        for at in rng.integers(0, len(damaged), rng.integers(0, 4)):
            damaged[at] = rng.integers(256)
        (tmp_path / "b.pcd").write_bytes(damaged)
        try:
            pcd.read(tmp_path / "b.pcd", OPTIONS)
        except ValueError as error:
            refused.append(str(error))
    assert len(refused) > 200
    assert not any("\n" in message for message in refused)
