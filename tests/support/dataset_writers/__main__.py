"""Small true files of every format, to be damaged: `PYTHONPATH=tests/support python -m dataset_writers DIR`."""

import json
import sys
from pathlib import Path

import numpy as np
from dataset_writers.arkitscenes import box, write_arkitscenes
from dataset_writers.e57 import write_e57
from dataset_writers.las import write_las
from dataset_writers.masks import write_masks
from dataset_writers.meshes import write_glb, write_obj
from dataset_writers.pcd import write_pcd
from dataset_writers.ply_file import vertex_columns, write_ply
from dataset_writers.replica import write_replica
from dataset_writers.s3dis import write_s3dis
from dataset_writers.scannet import write_scannet, write_scannetpp
from dataset_writers.threerscan import sequence_files, write_annotated_mesh, write_semseg, write_sequence

RNG = np.random.default_rng(5)
POINTS = RNG.uniform(-1, 1, (60, 3)).astype(np.float32).astype(np.float64)
IDS = np.repeat([0, 1, 2], 20).astype(np.int32)
RGB = RNG.integers(0, 256, (60, 3)).astype(np.uint8)
GROUPS = [(1, "chair", [1]), (2, "round table", [2])]


def wall() -> np.ndarray:
    """What the depth frames of the fixture show, 1.5 m before the camera: a point a pixel."""
    v, u = np.divmod(np.arange(48), 8)
    return np.stack([(u - 3.5) * 1.5 / 4, (v - 2.5) * 1.5 / 4, np.full(48, 1.5)], axis=-1)


def case(folder: Path, scan: Path, **options) -> None:
    """Describes the fixture: the scan's path and options of read_scan."""
    content = {"scan": str(scan.relative_to(folder)), "min_points": 4} | options
    (folder / "fixture.json").write_text(json.dumps(content))


def plain(root: Path) -> None:
    columns = vertex_columns(POINTS, RGB, instance=IDS)
    for name, text in (("ascii", True), ("binary", False)):
        folder = root / "ply" / name
        case(folder, write_ply(folder / "room.ply", columns, [[0, 1, 2]], text=text))
    folder = root / "ply_folder" / "objects"
    for i in (1, 2):
        write_ply(folder / f"chair_{i}.ply", vertex_columns(POINTS[i == IDS]), text=i == 1)
    case(folder, folder)
    folder = root / "npz" / "labeled"
    folder.mkdir(parents=True)
    labels = np.array(["floor", "chair", "table"])[IDS]
    np.savez(folder / "room.npz", points=POINTS, instance=IDS, label=labels, color=RGB)
    case(folder, folder / "room.npz")


def meshes(root: Path) -> None:
    boxes = {"chair": ((0.0, 0.5, 0.0), (0.5, 1.0, 0.5)), "table": ((2.0, 0.4, 0.0), (1.2, 0.8, 0.7))}
    for suffix, write in (("obj", write_obj), ("glb", write_glb)):
        folder = root / suffix / "boxes"
        folder.mkdir(parents=True)
        case(folder, write(folder / f"room.{suffix}", boxes))


def surveys(root: Path) -> None:
    for encoding in ("ascii", "binary", "binary_compressed"):
        folder = root / "pcd" / encoding
        folder.mkdir(parents=True)
        fields = {axis: POINTS[:, i].astype(np.float32) for i, axis in enumerate("xyz")} | {"instance": IDS}
        case(folder, write_pcd(folder / "room.pcd", fields, encoding))
    for suffix in ("las", "laz"):
        folder = root / suffix / "colors"
        folder.mkdir(parents=True)
        case(folder, write_las(folder / f"room.{suffix}", POINTS, RGB.astype(np.uint16) * 257, instance=IDS))
    folder = root / "e57" / "two_scans"
    folder.mkdir(parents=True)
    scans = [
        {"points": POINTS[:30], "colors": RGB[:30], "translation": (1.0, 2.0, 3.0)},
        {"points": POINTS[30:], "colors": RGB[30:], "rotation": (0.5, -0.5, 0.5, 0.5)},
    ]
    np.savez(folder / "masks.npz", objectId=IDS)
    case(folder, write_e57(folder / "room.e57", scans), masks="masks.npz")


def masks(root: Path) -> None:
    folder = root / "masks" / "benchmark"
    cloud = write_ply(folder / "room.ply", vertex_columns(POINTS))
    write_masks(folder / "out" / "room.txt", IDS[:, None] == [1, 2], ("chair", 7), (0.9, 0.8))
    case(folder, cloud, masks="out")
    folder = root / "masks" / "npz"
    cloud = write_ply(folder / "room.ply", vertex_columns(POINTS))
    arrays = {"masks": IDS[:, None] == [1, 2], "scores": np.array([0.9, 0.8]), "labels": np.array([7, 9])}
    np.savez(folder / "masks.npz", **arrays)
    case(folder, cloud, masks="masks.npz")


def datasets(root: Path) -> None:
    folder = root / "arkitscenes" / "41"
    boxes = [box("chair", [0, 0, 0], [1, 1, 2]), box("table", [0.5, 0.5, 0], [1, 1, 2])]
    case(folder, write_arkitscenes(folder, POINTS, boxes), min_points=1)
    folder = root / "scannet" / "scene0001_00"
    write_scannet(folder, POINTS, IDS, [(i - 1, *rest) for i, *rest in GROUPS], alignment=np.eye(4))
    case(folder, folder)
    folder = root / "scannetpp" / "3db0a1c8f3"
    case(folder, write_scannetpp(folder, POINTS, IDS, GROUPS))
    folder = root / "replica" / "room_0"
    quads = [[i, i + 1, i + 2, i + 3] for i in range(0, 60, 4)]
    case(folder, write_replica(folder, POINTS, quads, IDS[::4], {1: "chair", 2: "table"}))
    folder = root / "s3dis" / "office_1"
    objects = {f"{n}_1": (POINTS[i == IDS], RGB[i == IDS]) for i, n in enumerate(("floor", "chair", "table"))}
    case(folder, write_s3dis(folder, objects))
    for name, zipped in (("mesh", None), ("depth_zip", True), ("depth_folder", False)):
        folder = root / "threerscan" / name
        write_annotated_mesh(folder, wall(), IDS[12:], RGB[12:])
        write_semseg(folder, {1: "chair", 2: "table"})
        if zipped is not None:
            depth = np.full((6, 8), 1500, np.uint16)
            camera = {"fx": 4.0, "fy": 4.0, "cx": 3.5, "cy": 2.5}
            write_sequence(folder, sequence_files([(depth, np.eye(4))] * 2, camera), zipped=zipped)
        case(folder, folder, **({} if zipped is None else {"depth_frames": True, "min_points": 1}))


def write_fixtures(root: Path) -> Path:
    """A folder a format, in it one a case."""
    for write in (plain, meshes, surveys, masks, datasets):
        write(root)
    return root


if __name__ == "__main__":
    write_fixtures(Path(sys.argv[1]))
