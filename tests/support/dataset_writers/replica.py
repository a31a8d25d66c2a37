"""Replica as it is published: a mesh of quads whose faces carry the object, and the classes of the objects."""

import json
from pathlib import Path

import numpy as np
from dataset_writers.ply_file import vertex_columns, write_ply


def write_replica(scene: Path, points, faces, face_object, classes: dict) -> Path:
    """`classes`: object id → class name. Returns the scene's folder."""
    habitat = scene / "habitat"
    columns = vertex_columns(points, np.tile(np.arange(len(points))[:, None] % 256, (1, 3)))
    objects = {"object_id": np.asarray(face_object, np.uint16)}
    write_ply(habitat / "mesh_semantic.ply", columns, faces, face_columns=objects)
    rows = [
        {"id": i, "class_id": n, "class_name": name, "oriented_bbox": {"abb": {"center": [0, 0, 0]}}}
        for n, (i, name) in enumerate(classes.items())
    ]
    content = {"gravity_dir": [0, 0, -1], "id_to_label": [], "objects": rows}
    (habitat / "info_semantic.json").write_text(json.dumps(content))
    return scene
