"""OBJ and GLB by hand: named boxes, each where it stands, and what they look like to an independent reader."""

import json
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

Box = tuple[tuple[float, float, float], tuple[float, float, float]]  # middle, edges
CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
# Outward, two a side.
FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    + [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
)


def write_obj(path: Path, boxes: Mapping[str, Box]) -> Path:
    """An `o` a box; vertices count over all of them."""
    lines, count = ["# by hand"], 0
    for name, (middle, edges) in boxes.items():
        lines.append(f"o {name}")
        lines += ["v " + " ".join(f"{x:.6f}" for x in v) for v in CORNERS * edges + middle]
        lines += ["f " + " ".join(str(i + 1 + count) for i in f) for f in FACES]
        count += len(CORNERS)
    path.write_text("\n".join(lines) + "\n")
    return path


def write_glb(path: Path, boxes: Mapping[str, Box]) -> Path:
    """A node a box, which moves it where it stands; one binary chunk."""
    views, accessors, meshes, nodes, blob = [], [], [], [], b""
    for name, (middle, edges) in boxes.items():
        vertices, faces = (CORNERS * edges).astype("<f4"), FACES.astype("<u2")
        for data, target, kind, count, shape in (
            (vertices.tobytes(), 34962, 5126, len(vertices), "VEC3"),
            (faces.tobytes(), 34963, 5123, faces.size, "SCALAR"),
        ):
            views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(data), "target": target})
            accessors.append(
                {"bufferView": len(views) - 1, "componentType": kind, "count": count, "type": shape}
            )
            blob += data
        accessors[-2] |= {"min": vertices.min(axis=0).tolist(), "max": vertices.max(axis=0).tolist()}
        primitive = {"attributes": {"POSITION": len(accessors) - 2}, "indices": len(accessors) - 1, "mode": 4}
        meshes.append({"name": name, "primitives": [primitive]})
        nodes.append({"name": name, "mesh": len(meshes) - 1, "translation": list(middle)})
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": meshes,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob)}],
    }
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    blob += b"\0" * (-len(blob) % 4)
    chunks = (
        struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(blob), 0x004E4942) + blob
    )
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return path
