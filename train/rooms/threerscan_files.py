"""One scan in 3RScan's folder layout: what its annotators published, and what the paper's evaluation adds.

<scan>/labels.instances.annotated.v2.ply   vertices with `objectId`, and faces; ASCII
<scan>/mesh.refined.v2.obj                 the same surface, bare
<scan>/semseg.v2.json                      objectId, label and box of every annotated object
<scan>/sequence.zip                        depth frames (16 bits, millimeters), their poses, the camera
<scan>/pointcloud.instances.align.ply      these frames back-projected, in the reference's frame
<scan>/pointcloud.labels.npz               the annotated objectId of every such point
<scan>/mask3d.labels.npz                   the predicted one; 0: none
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int
from plyfile import PlyData, PlyElement

from more2_jax.geometry.poses import Points, Pose, apply_pose
from more2_jax.scans.files.rgbd_sequence import DEPTH, INFO, POSE, Intrinsics, back_project
from train.rooms.depth_sensor import DepthSensor, FrameCaster

UNITS_A_METER = 1000.0  # of depth


@dataclass(frozen=True, kw_only=True)
class AnnotatedScan:
    """A scan in its own frame, meters, with the objectId that annotators gave every vertex, and a network (0: none)."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]  # no rows: a cloud
    object_id: Int[np.ndarray, " v"]
    predicted_id: Int[np.ndarray, " v"]
    labels: dict[int, str]


def write_annotated(folder: Path, scan: AnnotatedScan) -> None:
    """Writes the annotated mesh, the bare one, and the list of objects."""
    folder.mkdir(parents=True, exist_ok=True)
    corners = np.insert(scan.faces, 0, 3, axis=1)
    with (folder / "labels.instances.annotated.v2.ply").open("w", encoding="ascii", newline="\n") as file:
        file.write(_header(len(scan.vertices), len(scan.faces)))
        no_color, no_value = np.zeros((len(scan.vertices), 3)), np.zeros((len(scan.vertices), 4))
        rows = np.column_stack([scan.vertices, no_color, scan.object_id, no_value])
        np.savetxt(file, rows, "%.6f %.6f %.6f %d %d %d %d %d %d %d %d")
        np.savetxt(file, corners, "%d")
    with (folder / "mesh.refined.v2.obj").open("w", encoding="ascii", newline="\n") as file:
        np.savetxt(file, scan.vertices, "v %.6f %.6f %.6f")
        np.savetxt(file, scan.faces + 1, "f %d %d %d")
    groups = [_group(scan, i, label) for i, label in sorted(scan.labels.items())]
    text = json.dumps({"scan_id": folder.name, "appId": "Aggregator.v2", "segGroups": groups})
    (folder / "semseg.v2.json").write_text(text, encoding="utf-8")


def _header(vertices: int, faces: int) -> str:
    """Of the annotated mesh; nobody reads the colors and the values after objectId."""
    kinds = [("float", n) for n in "xyz"] + [("uchar", n) for n in ("red", "green", "blue")]
    kinds += [("ushort", n) for n in ("objectId", "globalId")]
    kinds += [("uchar", n) for n in ("NYU40", "Eigen13", "RIO27")]
    lines = ["ply", "format ascii 1.0", f"element vertex {vertices}"]
    lines += [f"property {kind} {name}" for kind, name in kinds]
    lines += [f"element face {faces}", "property list uchar int vertex_indices", "end_header"]
    return "\n".join(lines) + "\n"


def _group(scan: AnnotatedScan, id_: int, label: str) -> dict[str, object]:
    own = scan.vertices[scan.object_id == id_]
    low, high = (own.min(axis=0), own.max(axis=0)) if len(own) else (np.zeros(3), np.zeros(3))
    box = {"centroid": ((low + high) / 2).tolist(), "axesLengths": (high - low).tolist()}
    return {"id": id_, "objectId": id_, "label": label, "segments": [], "obb": box}


def write_depth(
    folder: Path,
    scan: AnnotatedScan,
    T_scan_camera: Float[np.ndarray, "frames 4 4"],
    T_ref_scan: Pose,
    sensor: DepthSensor,
    rng: np.random.Generator,
) -> None:
    """Writes depth frames of the scan's mesh, with the sensor's noise, and the clouds that are made of them.

    A point belongs to the object of the face that its ray hits, as rendered annotations have it.
    """
    caster = FrameCaster(trimesh.Trimesh(scan.vertices, scan.faces, process=False), sensor)
    camera = intrinsics(sensor)
    corner = scan.faces[:, 0]
    clouds: list[Points] = []
    hit: list[np.ndarray] = []  # by point, a vertex of the face
    files = {INFO: _info(camera, sensor, len(T_scan_camera))}
    for k, T in enumerate(T_scan_camera):
        frame = caster.frame(T, rng)
        depth = np.rint(UNITS_A_METER * frame.measured).astype(np.uint16)
        image = depth.reshape(sensor.height, sensor.width)
        clouds.append(back_project(image, camera, T, 1))
        hit.append(corner[frame.face[depth > 0]])
        header = f"P5\n{sensor.width} {sensor.height}\n65535\n".encode()
        files[f"frame-{k:06d}{DEPTH}"] = header + image.astype(">u2").tobytes()
        files[f"frame-{k:06d}{POSE}"] = "\n".join(" ".join(map(str, row)) for row in T.tolist()).encode()
    with zipfile.ZipFile(folder / "sequence.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    write_clouds(folder, apply_pose(T_ref_scan, np.concatenate(clouds)), scan, np.concatenate(hit))


def write_clouds(folder: Path, points: Points, scan: AnnotatedScan, vertex: Int[np.ndarray, " n"]) -> None:
    """Writes points of the reference's frame, and the labels that each takes from a vertex of the scan."""
    table = np.empty(len(points), [(n, "<f4") for n in "xyz"])
    for name, column in zip("xyz", points.T, strict=True):
        table[name] = column
    cloud = PlyData([PlyElement.describe(table, "vertex")], byte_order="<")
    cloud.write(str(folder / "pointcloud.instances.align.ply"))
    for name, ids in (("pointcloud", scan.object_id), ("mask3d", scan.predicted_id)):
        np.savez_compressed(folder / f"{name}.labels.npz", objectId=ids[vertex].astype(np.int64))


def intrinsics(sensor: DepthSensor) -> Intrinsics:
    """The sensor's camera: whole numbers are the middles of pixels."""
    return Intrinsics(
        fx=sensor.focal,
        fy=sensor.focal,
        cx=sensor.width / 2 - 0.5,
        cy=sensor.height / 2 - 0.5,
        depth_shift=UNITS_A_METER,
    )


def _info(camera: Intrinsics, sensor: DepthSensor, frames: int) -> bytes:
    """`_info.txt`: the camera, as lines `name = value`."""
    matrix: Sequence[float] = (
        *(camera.fx, 0.0, camera.cx, 0.0),
        *(0.0, camera.fy, camera.cy, 0.0),
        *(0.0, 0.0, 1.0, 0.0),
        *(0.0, 0.0, 0.0, 1.0),
    )
    same = " ".join(map(str, np.eye(4, dtype=int).ravel()))
    lines = {
        "m_versionNumber": 4,
        "m_sensorName": "simulated",
        "m_depthWidth": sensor.width,
        "m_depthHeight": sensor.height,
        "m_depthShift": f"{UNITS_A_METER:g}",
        "m_calibrationDepthIntrinsic": " ".join(map(str, matrix)),
        "m_calibrationDepthExtrinsic": same,
        "m_frames.size": frames,
    }
    return "".join(f"{name} = {value}\n" for name, value in lines.items()).encode()
