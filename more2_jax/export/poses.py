"""JSON: poses and changes, without geometry."""

from __future__ import annotations

import json
from pathlib import Path

from more2_jax.storage.scene_folder import scene_to_json
from more2_jax.types import LivingScene


def write_poses(scene: LivingScene, path: Path, scan: int) -> None:
    """What scene.json holds, less colors and names of files beside it; `scan` chooses nothing: all are written."""
    content = scene_to_json(scene)
    left_out = ("mesh", "points", "color")
    objects = [{k: v for k, v in o.items() if k not in left_out} for o in content.pop("objects")]
    text = json.dumps(content | {"up_axis": "z", "objects": objects}, indent=1, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")
