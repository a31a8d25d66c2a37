"""A living scene for other tools: glTF, USD, PLY, JSON, a module each; `export_scene` is the door.

May import `report` (its colors), `storage`, `tracking`, `geometry`, `types`, `whole_file`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from more2_jax.export.glb import write_glb
from more2_jax.export.placing import pose_in
from more2_jax.export.ply import write_ply
from more2_jax.export.poses import write_poses
from more2_jax.export.usd import write_usd
from more2_jax.storage.scene_folder import WRITTEN
from more2_jax.types import LivingScene
from more2_jax.whole_file import check_writable, whole_file

__all__ = ["SUFFIXES", "export_scene", "pose_in"]

SUFFIXES = {"glb": ".glb", "usd": ".usda", "ply": ".ply", "json": ".json"}

Writer = Callable[[LivingScene, Path, int], None]
WRITERS: dict[str, Writer] = {"glb": write_glb, "usd": write_usd, "ply": write_ply, "json": write_poses}


def export_scene(scene: LivingScene, target: str | Path, format: str, *, scan: int = -1) -> Path:
    """Writes the scene as one file, whole or not at all, and returns its path.

    `target` is a file, or a folder, in which the file is called `export` and the format's suffix. Lengths are
    meters. Every object's mesh lies in the frame of its reference observation, so `inverse(T_ref_scan)` puts it
    where a scan saw it. `scan` counts from 0, or from the last with −1.

    - glb: a node an object with its mesh (points where it has none), an animation over all scans of one second
      each, and `scan` as the arrangement at rest; y is up, as glTF has it.
    - usd: a node an object, poses and visibility as time samples, 0 the first scan; z is up, as in the scans;
      needs the extra `usd`.
    - ply: the accumulated points as they lie in `scan`; the vertex property `object` is the object's number.
    - json: poses and changes only, as in the living-scene folder's scene.json; z is up.

    Where a scan did not look at the place of an object (*not seen*), glb and usd show it there, pale, by a node
    `<id>_not_seen`, and say so a scan (glb: `extras.states`; usd: the attribute `more2:state`: `seen`, `not_seen` or
    `absent`); ply names its number in a comment; json has `scans[].not_seen` and `changes[].not_seen`.

    Raises ValueError for an unknown format or scan, a scan without objects (glb, ply), USD without its extra, a
    folder that cannot be written, or a path that would overwrite part of a living scene.
    """
    if format not in WRITERS:
        raise ValueError(f"format {format!r}; needed one of {', '.join(WRITERS)}")
    if not -len(scene.scans) <= scan < len(scene.scans):
        raise ValueError(
            f"scan {scan} of {len(scene.scans)}; needed 0 to {len(scene.scans) - 1}, or −1 for the last"
        )
    target = Path(target)
    path = target / f"export{SUFFIXES[format]}" if target.is_dir() else target
    if path.name in WRITTEN and (path.parent / "scene.json").exists():
        raise ValueError(f"{path}: part of a living scene; needed another file")
    check_writable(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as partial:
        WRITERS[format](scene, partial, scan % len(scene.scans))
    return path
