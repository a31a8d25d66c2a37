"""ARKitScenes as it is published: a mesh and, beside it, oriented boxes with much that is passed over."""

import json
from pathlib import Path

import numpy as np
from dataset_writers.ply_file import vertex_columns, write_ply


def box(label: str, center, lengths, axes=None) -> dict:
    """`axes` (3, 3): rows are the box's axes."""
    axes = np.eye(3) if axes is None else np.asarray(axes)
    aligned = {
        "centroid": [float(v) for v in center],
        "axesLengths": [float(v) for v in lengths],
        "normalizedAxes": [float(v) for v in axes.ravel()],
    }
    return {
        "uid": f"uid-{label}",
        "label": label,
        "modelId": "",
        "objectId": 1,  # repeats in real files
        "segments": {"obb": {"centroid": [0, 0, 0]}, "segments": [1, 2], "obbAligned": aligned},
    }


def write_arkitscenes(folder: Path, points: np.ndarray, boxes: list[dict]) -> Path:
    """Returns the folder `<id>/`."""
    colors = np.full((len(points), 3), 90, np.uint8)
    write_ply(folder / f"{folder.name}_3dod_mesh.ply", vertex_columns(points, colors), [[0, 1, 2]])
    content = {"data": boxes, "stats": {}, "comment": "", "confirm": 1, "skipped": False}
    (folder / f"{folder.name}_3dod_annotation.json").write_text(json.dumps(content))
    return folder
