"""Fine points and surfaces of a large scene's objects: a file each beside the page, which reads it when it is near.

A page from disk may not fetch, but it may run a script: so a file is a call of one function with its data.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from more2_jax.report.blob import Blob
from more2_jax.report.shape import anchor_of, cloud_in, is_closed, surface_in
from more2_jax.report.thinning import (
    MAX_DETAIL_FACES,
    MAX_DETAIL_POINTS,
    MAX_FACES,
    MAX_POINTS,
    cluster_vertices,
    kept_share,
)
from more2_jax.types import LivingScene, SceneObject

DETAILS = "report_details"  # the folder beside the page
MOST_IN_ONE_FILE = 64  # objects: of more, a page holds too little each


def is_large(scene: LivingScene) -> bool:
    """Whether the scene has details: its objects are many, and more than one page holds."""
    if len(scene.objects) <= MOST_IN_ONE_FILE:
        return False
    points = sum(len(o.points) for o in scene.objects) + sum(len(s.background) for s in scene.scans)
    faces = sum(len(o.mesh.faces) for o in scene.objects if o.mesh is not None)
    return points > MAX_POINTS or faces > MAX_FACES


def report_details(scene: LivingScene) -> Iterator[tuple[str, str]]:
    """Name and text of every file of `DETAILS`, one at a time; none for a scene that its page holds alone."""
    if is_large(scene):
        for k, o in enumerate(scene.objects):
            yield f"{k}.js", _script(o)  # by place: an id that was read from a file need not do for a name


def write_details(folder: Path, details: Iterable[tuple[str, str]]) -> None:
    """Puts the files in place of the folder, filled beside it before; without any the folder is gone."""
    new = folder.with_name(f".{folder.name}.new")
    shutil.rmtree(new, ignore_errors=True)
    for name, text in details:
        new.mkdir(exist_ok=True)
        (new / name).write_text(text, encoding="utf-8")
    shutil.rmtree(folder, ignore_errors=True)
    if new.exists():
        new.rename(folder)


def detail_of(o: SceneObject) -> dict[str, Any]:
    """What the page must know before it reads a detail: which one fits, and how much it holds at most."""
    faces = 0 if o.mesh is None else len(o.mesh.faces)
    return {
        "stamp": _stamp(o),
        "points": min(len(o.points), MAX_DETAIL_POINTS),
        "faces": min(faces, MAX_DETAIL_FACES),
    }


def _script(o: SceneObject) -> str:
    blob = Blob()
    shape = cloud_in(blob, o, kept_share(len(o.points), MAX_DETAIL_POINTS)) | {"mesh": None}
    if o.mesh is not None:
        mesh = cluster_vertices(o.mesh, kept_share(len(o.mesh.faces), MAX_DETAIL_FACES))
        shape["mesh"] = surface_in(blob, mesh, anchor_of(o)) | {"closed": is_closed(mesh)}
    told = (_stamp(o), shape, blob.text())
    return f"more2Detail({','.join(json.dumps(t, separators=(',', ':'), allow_nan=False) for t in told)});\n"


def _stamp(o: SceneObject) -> str:
    """The same only for the same points and surface: what lies beside an older page is not taken for its own."""
    content = hashlib.sha256(o.points.tobytes())
    if o.mesh is not None:
        content.update(o.mesh.vertices.tobytes())
    return content.hexdigest()[:16]
