"""3RScan as it is published: ascii PLY with ushort objectId, semseg.v2.json, sequence.zip, 3RScan.json."""

import json
import zipfile
from pathlib import Path

import numpy as np
from dataset_writers.ply_file import vertex_columns, write_ply


def write_annotated_mesh(folder: Path, points, object_id, colors=None) -> Path:
    n = len(points)
    colors = np.zeros((n, 3), np.uint8) if colors is None else colors
    columns = vertex_columns(
        points,
        colors,
        objectId=np.asarray(object_id, np.uint16),
        globalId=np.zeros(n, np.uint16),
        NYU40=np.zeros(n, np.uint8),
        Eigen13=np.zeros(n, np.uint8),
        RIO27=np.zeros(n, np.uint8),
    )
    faces = [[i, i + 1, i + 2] for i in range(0, n - 2, 3)]
    return write_ply(folder / "labels.instances.annotated.v2.ply", columns, faces, text=True)


def write_semseg(folder: Path, labels: dict[int, str], *, strings=False) -> Path:
    """`strings`: some scans write ids as strings."""
    groups = [
        {
            "id": str(i) if strings else i,
            "objectId": str(i) if strings else i,
            "label": label,
            "segments": [i, i + 100],
            "obb": {"centroid": [0.0, 0.0, 0.0], "axesLengths": [1.0, 1.0, 1.0]},
        }
        for i, label in labels.items()
    ]
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "semseg.v2.json"
    file.write_text(json.dumps({"scan_id": folder.name, "appId": "Aggregator.v2", "segGroups": groups}))
    return file


def info_text(width: int, height: int, fx: float, fy: float, cx: float, cy: float, frames: int) -> str:
    one = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
    lines = {
        "m_versionNumber": 4,
        "m_sensorName": "Tango",
        "m_colorWidth": 960,
        "m_colorHeight": 540,
        "m_depthWidth": width,
        "m_depthHeight": height,
        "m_depthShift": 1000,
        "m_calibrationColorIntrinsic": "756.832 0 492.889 0 0 756.026 270.419 0 0 0 1 0 0 0 0 1",
        "m_calibrationColorExtrinsic": one,
        "m_calibrationDepthIntrinsic": f"{fx!r} 0 {cx!r} 0 0 {fy!r} {cy!r} 0 0 0 1 0 0 0 0 1",
        "m_calibrationDepthExtrinsic": one,
        "m_frames.size": frames,
    }
    return "".join(f"{name} = {value}\n" for name, value in lines.items())


def pgm_bytes(depth_mm: np.ndarray) -> bytes:
    """16 bits, most significant byte first."""
    height, width = depth_mm.shape
    return b"P5\n%d %d\n65535\n" % (width, height) + depth_mm.astype(">u2").tobytes()


def sequence_files(frames: list, camera: dict) -> dict[str, bytes]:
    """`frames`: (depth in mm, T_world_camera or the text of a pose, or None for a frame without a pose)."""
    height, width = frames[0][0].shape
    files = {"_info.txt": info_text(width, height, frames=len(frames), **camera).encode()}
    for i, (depth_mm, pose) in enumerate(frames):
        files[f"frame-{i:06d}.depth.pgm"] = pgm_bytes(depth_mm)
        files[f"frame-{i:06d}.color.jpg"] = b"\xff\xd8\xff"
        if pose is not None:
            rows = (
                pose
                if isinstance(pose, str)
                else "\n".join(" ".join(repr(float(v)) for v in r) for r in pose)
            )
            files[f"frame-{i:06d}.pose.txt"] = rows.encode()
    return files


def write_sequence(folder: Path, files: dict[str, bytes], *, zipped=True) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    if zipped:
        with zipfile.ZipFile(folder / "sequence.zip", "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in files.items():
                archive.writestr(name, content)
    else:
        (folder / "sequence").mkdir()
        for name, content in files.items():
            (folder / "sequence" / name).write_bytes(content)


def column_major(T: np.ndarray) -> list[float]:
    """16 numbers, column by column, as `3RScan.json` has them."""
    return [float(T[row, column]) for column in range(4) for row in range(4)]
