"""S3DIS as it is published: `Area_x/<room>/Annotations/<class>_<number>.txt`, lines of x y z r g b."""

from pathlib import Path

import numpy as np


def write_s3dis(room: Path, objects: dict[str, tuple[np.ndarray, np.ndarray]]) -> Path:
    """`objects`: `chair_1` → points and colors. Also the room's own file and what the archives carry along."""
    folder = room / "Annotations"
    folder.mkdir(parents=True)
    text = {name: s3dis_lines(*object_) for name, object_ in objects.items()}
    for name, lines in text.items():
        (folder / f"{name}.txt").write_text(lines)
    (room / f"{room.name}.txt").write_text("".join(text.values()))
    (folder / ".DS_Store").write_bytes(b"\0\0\0\1Bud1")
    return room


def s3dis_lines(points, colors) -> str:
    rows = zip(points, colors, strict=True)
    return "".join(f"{x:.3f} {y:.3f} {z:.3f} {r} {g} {b}\n" for (x, y, z), (r, g, b) in rows)
