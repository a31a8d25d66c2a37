"""ScanNet and ScanNet++ as they are published: a mesh, a segment a vertex, and groups of segments."""

import json
from pathlib import Path

import numpy as np
from dataset_writers.ply_file import vertex_columns, write_ply


def write_scannet(folder: Path, points, segments, groups, *, alignment=None, strings=False) -> Path:
    """`groups`: (objectId from 0, label, segments). `strings`: ids as strings. Returns the mesh."""
    scene, text = folder.name, str if strings else int
    colors = np.full((len(points), 3), 128, np.uint8)
    alpha = np.full(len(points), 255, np.uint8)
    faces = [[i, i + 1, i + 2] for i in range(len(points) - 2)]
    mesh = write_ply(folder / f"{scene}_vh_clean_2.ply", vertex_columns(points, colors, alpha=alpha), faces)
    indices = {"params": {"kThresh": "0.0001"}, "sceneId": scene, "segIndices": [text(s) for s in segments]}
    (folder / f"{scene}_vh_clean_2.0.010000.segs.json").write_text(json.dumps(indices))
    rows = [
        {"id": text(i), "objectId": text(i), "segments": [text(s) for s in own], "label": label}
        for i, label, own in groups
    ]
    content = {"sceneId": f"scannet.{scene}", "appId": "Aggregator.v2", "segGroups": rows}
    (folder / f"{scene}.aggregation.json").write_text(json.dumps(content))
    lines = ["colorHeight = 968", "sceneType = Office"]
    if alignment is not None:
        lines.insert(0, "axisAlignment = " + " ".join(repr(float(v)) for v in alignment.ravel()) + " ")
    (folder / f"{scene}.txt").write_text("\n".join(lines) + "\n")
    return mesh


def write_scannetpp(scene: Path, points, segments, groups) -> Path:
    """`groups`: (id, label, segments). Returns the scene's folder."""
    scans = scene / "scans"
    faces = [[i, i + 1, i + 2] for i in range(len(points) - 2)]
    write_ply(scans / "mesh_aligned_0.05.ply", vertex_columns(points, np.zeros((len(points), 3))), faces)
    indices = {"sceneId": scene.name, "segIndices": [int(s) for s in segments]}
    (scans / "segments.json").write_text(json.dumps(indices))
    rows = [
        {"id": i, "objectId": i, "label": label, "segments": [int(s) for s in own], "obb": {}}
        for i, label, own in groups
    ]
    (scans / "segments_anno.json").write_text(json.dumps({"sceneId": scene.name, "segGroups": rows}))
    return scene
