"""The living-scene folder (schema version 1): written whole or not at all, read back as it was.

A save fills `.NAME.new` beside the folder `NAME`, renames `NAME` to `.NAME.old`, `.NAME.new` to `NAME`, and
removes `.NAME.old`. A process killed between the two renames leaves no `NAME` but a whole `.NAME.old`: every
reader here then reads that, and the next save first renames it back. Killed at any other moment, `NAME` is
the old folder or the new one, and the next save clears what lies beside it.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from more2_jax.config import SceneConfig, to_yaml
from more2_jax.storage.ply_files import read_mesh, read_points, write_mesh, write_points
from more2_jax.storage.scene_json import VERSION, mesh_name, points_name, scene_to_json
from more2_jax.storage.scene_lock import scene_lock
from more2_jax.storage.stored_settings import read_settings
from more2_jax.types import (
    Anchors,
    Changes,
    Color,
    Embedding,
    Frame,
    LivingScene,
    Observation,
    Repair,
    ScanRecord,
    SceneObject,
    Skipped,
)
from more2_jax.whole_file import check_writable

PAGE = "report.html"
DETAILS = "report_details"  # of a large scene's page
WRITTEN = (
    "scene.json",
    "objects",
    "background.ply",
    "embeddings.npz",
    PAGE,
    DETAILS,
    "run.log",
    "config.yaml",
)
EMBEDDING = ("inv", "eqv", "scale", "center", "origin")
ANCHORS = ("offset", "features", "mask")
# What NumPy, zipfile, json, yaml and our own records raise for files that are damaged or missing.
DAMAGE = (
    KeyError,
    TypeError,
    ValueError,
    IndexError,
    OSError,
    EOFError,
    AttributeError,
    zipfile.BadZipFile,
    zlib.error,
    yaml.YAMLError,
)


# --- where it lies ------------------------------------------------------------------------------------------


def stored_at(folder: str | Path) -> Path:
    """The folder that holds the living scene `folder`: itself, or `.NAME.old` after a swap cut short."""
    folder = Path(folder).resolve()
    old = _beside(folder, "old")
    return old if not folder.exists() and (old / "scene.json").is_file() else folder


def check_output(folder: str | Path) -> None:
    """Raises ValueError unless a living scene may be written to `folder`: new, empty, or a living scene."""
    folder = Path(folder).resolve()
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder}: a file; needed a folder for the living scene")
    if os.path.ismount(folder):
        raise ValueError(f"{folder}: a mount point cannot be replaced; needed a folder inside it")
    if folder.is_dir() and any(folder.iterdir()) and not _is_scene(folder):
        raise ValueError(f"{folder}: output folder not empty and not a living scene; needed a new folder")
    check_writable(folder)


def _beside(folder: Path, kind: str) -> Path:
    return folder.with_name(f".{folder.name}.{kind}")


def _is_scene(folder: Path) -> bool:
    try:
        return "version" in json.loads((folder / "scene.json").read_text())
    except (OSError, ValueError, TypeError):
        return False


# --- writing ------------------------------------------------------------------------------------------------


def save_scene(
    scene: LivingScene,
    folder: str | Path,
    config: SceneConfig,
    *,
    log: str = "",
    page: str | None = None,
    details: Iterable[tuple[str, str]] = (),
) -> None:
    """Writes the living-scene folder, whole or not at all; a living scene already there is replaced.

    `log` is appended to the folder's run.log. `page` is the scene's HTML (`report.report_html`), stored as
    report.html; with None the folder has no page, `more2 show` makes one. `details` are names and texts of the files
    the page reads (`report.report_details`), taken one at a time. Other files in the folder are kept.
    Raises ValueError where `check_output` does, when a number of the scene is not finite, without objects, or if
    another process works on the folder.
    """
    check_output(folder)
    if not scene.objects:
        raise ValueError("the living scene has no objects; needed at least one")
    folder = Path(folder).resolve()
    with scene_lock(folder):
        _swap_in(scene, folder, config, log, page, details)


def _swap_in(
    scene: LivingScene,
    folder: Path,
    config: SceneConfig,
    log: str,
    page: str | None,
    details: Iterable[tuple[str, str]],
) -> None:
    """Fills a folder beside, and puts it in the place of the one that is there."""
    new, old = _beside(folder, "new"), _beside(folder, "old")
    folder.parent.mkdir(parents=True, exist_ok=True)
    if old.exists() and not folder.exists():
        old.rename(folder)
    for left_over in (new, old):
        shutil.rmtree(left_over, ignore_errors=True)
    try:
        _fill(new, scene, config, _log_of(folder) + log)
        if page is not None:
            _write_page(new, page, details)
        _keep_other_files(folder, new)
    except BaseException:
        shutil.rmtree(new, ignore_errors=True)
        raise
    if folder.exists():
        folder.rename(old)
    new.rename(folder)
    shutil.rmtree(old, ignore_errors=True)


def _fill(folder: Path, scene: LivingScene, config: SceneConfig, log: str) -> None:
    (folder / "objects").mkdir(parents=True)
    text = json.dumps(scene_to_json(scene), indent=1, allow_nan=False)
    (folder / "scene.json").write_text(text + "\n", encoding="utf-8")
    for o in scene.objects:
        write_points(folder / points_name(o), o.points, o.point_scan, normals=o.normals)
        if o.mesh is not None:
            write_mesh(folder / mesh_name(o), o.mesh)
    _write_background(folder / "background.ply", scene.scans)
    stacked = _stacked([o.embedding for o in scene.objects])
    ids = np.array([o.id for o in scene.objects])
    np.savez_compressed(folder / "embeddings.npz", **({"id": ids} | stacked))  # type: ignore[arg-type]
    (folder / "config.yaml").write_text(to_yaml(config), encoding="utf-8")
    (folder / "run.log").write_text(log, encoding="utf-8")


def _write_page(folder: Path, page: str, details: Iterable[tuple[str, str]]) -> None:
    (folder / PAGE).write_text(page, encoding="utf-8")
    for name, text in details:
        (folder / DETAILS).mkdir(exist_ok=True)
        (folder / DETAILS / name).write_text(text, encoding="utf-8")


def _write_background(path: Path, scans: Sequence[ScanRecord]) -> None:
    """One cloud of what belongs to no object; no file where no scan has any."""
    if not any(len(s.background) for s in scans):
        return
    owner = np.concatenate([np.full(len(s.background), s.index) for s in scans])
    write_points(path, np.concatenate([s.background for s in scans]), owner)


def _log_of(folder: Path) -> str:
    path = folder / "run.log"
    return path.read_text(encoding="utf-8") if path.is_file() else ""


def _keep_other_files(folder: Path, new: Path) -> None:
    """Copies to `new` what people put into the folder beside the living scene."""
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.name in WRITTEN:
            continue
        if path.is_dir():
            shutil.copytree(path, new / path.name, symlinks=True)
        else:
            shutil.copy2(path, new / path.name, follow_symlinks=False)


# --- reading ------------------------------------------------------------------------------------------------


def load_scene(folder: str | Path) -> tuple[LivingScene, SceneConfig]:
    """Reads a living-scene folder and the settings it was made with.

    Raises ValueError, in one line, when there is no living scene, it is of another version, or it is damaged.
    """
    at = stored_at(folder)
    if not (at / "scene.json").is_file():
        raise ValueError(f"{folder}: no living scene (no scene.json); `more2 run` makes one")
    try:
        content = json.loads((at / "scene.json").read_text(encoding="utf-8"))
        if (version := content["version"]) == VERSION:
            return _scene(at, content), read_settings(at / "config.yaml")
    except DAMAGE as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{folder}: damaged living scene ({type(error).__name__}: {reason})") from error
    raise ValueError(f"{folder}: living scene of version {version!r}; needed {VERSION}")


def _scene(folder: Path, content: dict[str, Any]) -> LivingScene:
    embeddings = _embeddings(folder / "embeddings.npz")
    background, owner = _background(folder / "background.ply")
    scans = [
        s
        | {
            "instances": tuple(s["instances"]),
            "not_seen": tuple(s.get("not_seen", ())),
            "repairs": tuple(_repair(r) for r in s.get("repairs", ())),
            "skipped": tuple(Skipped(**k) for k in s.get("skipped", [])),
            "background": background[owner == s["index"]],
            "frame": _frame(s.get("frame")),
            "sensors": np.array(s.get("sensors", []), np.float64).reshape(-1, 3),
        }
        for s in content["scans"]
    ]
    frames = {s["index"]: s["frame"] for s in scans}
    kinds = ("moved", "static", "added", "removed")
    return LivingScene(
        preset=content["preset"],
        prior=content["prior"],
        upright=content["upright"],
        scans=tuple(ScanRecord(**s) for s in scans),
        objects=tuple(_object(folder, o, embeddings[o["id"]], frames) for o in content["objects"]),
        changes=tuple(
            Changes(
                from_scan=c["from"],
                to_scan=c["to"],
                **{k: tuple(c[k]) for k in kinds},
                not_seen=tuple(c.get("not_seen", ())),
                discovered=tuple(c.get("discovered", ())),
                probability=c.get("probability", {}),
            )
            for c in content["changes"]
        ),
        timing_s=content["timing_s"],
        unit=content["unit"],
    )


def _background(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The background's points and their scans; none where the scene has no such file."""
    return read_points(path)[:2] if path.is_file() else (np.zeros((0, 3)), np.zeros(0, np.int32))


def _stacked(embeddings: list[Embedding]) -> dict[str, np.ndarray]:
    """One array a field, a row an object; anchors as `anchors_<level>_<field>`."""
    if not embeddings:
        return {k: np.zeros(0) for k in EMBEDDING}
    stacked = {k: np.stack([np.asarray(getattr(e, k)) for e in embeddings]) for k in EMBEDDING}
    for level, name in itertools.product(range(len(embeddings[0].anchors)), ANCHORS):
        rows = [getattr(e.anchors[level], name) for e in embeddings]
        if rows[0] is not None:
            stacked[f"anchors_{level}_{name}"] = np.stack([np.asarray(row) for row in rows])
    for level in range(len(embeddings[0].anchors)):
        normal = np.stack([_normals(e.anchors[level]) for e in embeddings])
        if normal.any():  # folders of scenes without normals have no such arrays
            stacked[f"anchors_{level}_normal"] = normal
    return stacked


def _normals(anchors: Anchors) -> np.ndarray:
    """Zeros where none is known."""
    return np.zeros_like(anchors.offset) if anchors.normal is None else np.asarray(anchors.normal)


def _embeddings(path: Path) -> dict[str, Embedding]:
    with np.load(path, allow_pickle=False) as file:
        stacked = {k: file[k] for k in file.files}
    levels = sum(k.endswith("_offset") for k in stacked)

    def one(n: int) -> Embedding:
        anchors = tuple(_anchors(stacked, level, n) for level in range(levels))
        return Embedding(**{k: stacked[k][n] for k in EMBEDDING}, anchors=anchors)

    return {str(i): one(n) for n, i in enumerate(stacked["id"])}


def _anchors(stacked: dict[str, np.ndarray], level: int, n: int) -> Anchors:
    """Those of object `n`; what is not stored is not known, or not there."""
    offset, mask = (stacked[f"anchors_{level}_{k}"][n] for k in ("offset", "mask"))
    features, normal = (stacked.get(f"anchors_{level}_{k}") for k in ("features", "normal"))
    return Anchors(
        offset=offset,
        features=None if features is None else features[n],
        mask=mask,
        normal=np.zeros_like(offset) if normal is None else normal[n],
    )


def _repair(content: dict[str, Any]) -> Repair:
    lists: dict[str, Any] = {k: tuple(content[k]) for k in ("instances", "absorbed")}
    return Repair(**(content | lists))


def _frame(content: dict[str, Any] | None) -> Frame:
    """The frame of a scan; that of the scene where the file names none."""
    if content is None:
        return Frame()
    T = np.array(content["T_scene_scan"], np.float64)
    sigma = {k: content[k] for k in ("sigma_m", "sigma_deg")}
    noise_m, unknown = content.get("noise_m", 0.0), content.get("unknown", False)
    return Frame(T_scene_scan=T, noise_m=noise_m, unknown=unknown, **sigma)


def _object(
    folder: Path, o: dict[str, Any], embedding: Embedding, frames: Mapping[int, Frame]
) -> SceneObject:
    points, point_scan, normals = read_points(folder / o["points"])
    seen = [
        s | {"T_ref_scan": np.array(s["T_ref_scan"], np.float64), "frame": frames[s["scan"]]}
        for s in o["observations"]
    ]
    return SceneObject(
        id=o["id"],
        label=o["label"],
        reference_scan=o["reference_scan"],
        observations=tuple(Observation(**s) for s in seen),
        points=points,
        point_scan=point_scan,
        embedding=embedding,
        normals=normals,
        mesh=None if o["mesh"] is None else read_mesh(folder / o["mesh"]),
        color=_color(o.get("color")),
    )


def _color(content: dict[str, Any] | None) -> Color | None:
    """The color of an object; None where the file names none."""
    if content is None:
        return None
    return Color(points=content["points"], lab=np.array(content["lab"], np.float64))
