"""E57, the exchange format of laser scanners (ASTM E2807), through pye57: all scans of a file, in its frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from more2_jax.scans.files.ply_faces import unit_or_zero
from more2_jax.scans.labeled_cloud import LabeledCloud, ReadOptions, one_line
from more2_jax.types import Skipped

CHUNK = 1_000_000  # points read at once: a header that lies about their number costs no memory
CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
COLORS = ("colorRed", "colorGreen", "colorBlue")
NORMALS = ("nor:normalX", "nor:normalY", "nor:normalZ")  # of the extension for surface normals
INVALID = ("cartesianInvalidState", "sphericalInvalidState")


@dataclass(frozen=True, kw_only=True)
class StationScan:
    """One of the file's scans, in the file's frame."""

    points: Float[np.ndarray, "n 3"]
    colors: np.ndarray | None
    normals: Float[np.ndarray, "n 3"] | None
    invalid: int  # points left out, for they are marked so
    # Where the scanner stood: at the zero of its own points, which is known where the scan has a pose.
    place: Float[np.ndarray, "3"] | None


def recognizes(path: Path) -> bool:
    """Whether this is an E57 file, by its suffix."""
    return path.is_file() and path.suffix.lower() == ".e57"


def read(path: Path, options: ReadOptions) -> LabeledCloud:
    """Every scan of the file, moved by its pose, in the file's order. The format has no instances, only meters."""
    try:
        from pye57 import libe57  # pyright: ignore[reportAttributeAccessIssue]
    except ImportError as error:
        raise ValueError(f"{path}: needs the extra formats: pip install 'more2-jax[formats]'") from error
    try:
        image = libe57.ImageFile(str(path), "r")
        try:
            scans = [_scan(libe57, image, node) for node in image.root()["data3D"]]
        finally:
            image.close()
    except Exception as error:
        raise ValueError(f"{path}: truncated or damaged E57 ({one_line(error)})") from error
    return LabeledCloud(
        points=np.concatenate([np.zeros((0, 3)), *(s.points for s in scans)]),
        instance=None,
        colors=_of_all([s.colors for s in scans]),
        normals=_of_all([s.normals for s in scans]),
        skipped=tuple(
            Skipped(what=f"{s.invalid} points of scan {i}", reason="marked as invalid")
            for i, s in enumerate(scans)
            if s.invalid
        ),
        unit="m",
        sensors=np.array([s.place for s in scans if s.place is not None]).reshape(-1, 3),
    )


def _of_all(parts: list[np.ndarray | None]) -> np.ndarray | None:
    """End to end where every scan has it, else None."""
    known = [p for p in parts if p is not None]
    return np.concatenate(known) if parts and len(known) == len(parts) else None


def _scan(libe57: Any, image: Any, node: Any) -> StationScan:
    compressed = node["points"]
    prototype = libe57.StructureNode(compressed.prototype())
    has = {prototype.get(i).elementName() for i in range(prototype.childCount())}
    axes = CARTESIAN if has.issuperset(CARTESIAN) else SPHERICAL
    if not has.issuperset(axes):
        raise ValueError(
            f"a scan has {', '.join(sorted(has))}; needed {', '.join(CARTESIAN)} or {', '.join(axes)}"
        )
    invalid = INVALID[axes is SPHERICAL]
    names = [*axes, *({invalid} & has)]
    names += [n for group in (COLORS, NORMALS) if has.issuperset(group) for n in group]
    columns = _columns(libe57, image, compressed, names)
    good = columns[invalid] == 0 if invalid in columns else np.ones(len(columns[axes[0]]), bool)
    points = np.stack([columns[axis][good] for axis in axes], axis=-1)
    if axes is SPHERICAL:
        points = _cartesian(points)
    colors = None
    if COLORS[0] in columns:
        rgb = np.stack([columns[c][good] for c in COLORS], axis=-1)
        colors = _eight_bits(rgb, *_color_limits(node, prototype))
    zero, normals = _posed(node, np.zeros((1, 3))), None
    if NORMALS[0] in columns:
        normals = unit_or_zero(_posed(node, np.stack([columns[n][good] for n in NORMALS], axis=-1)) - zero)
    return StationScan(
        points=_posed(node, points),
        colors=colors,
        normals=normals,
        invalid=int((~good).sum()),
        place=zero[0] if node.isDefined("pose") else None,
    )


def _columns(libe57: Any, image: Any, compressed: Any, names: list[str]) -> dict[str, np.ndarray]:
    """The named columns as float64, whatever the file stores: integers are scaled, as their node says."""
    size = max(1, min(CHUNK, compressed.childCount()))
    arrays = {name: np.empty(size) for name in names}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(libe57.SourceDestBuffer(image, name, array, size, True, True))
    reader = compressed.reader(buffers)
    chunks = []
    while count := reader.read():
        chunks.append([array[:count].copy() for array in arrays.values()])
    reader.close()
    columns = zip(*chunks, strict=True) if chunks else [[np.zeros(0)]] * len(names)
    return {name: np.concatenate(column) for name, column in zip(names, columns, strict=True)}


def _cartesian(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Range, azimuth from x to y, and elevation above the xy plane (radians) to x, y, z."""
    distance, azimuth, elevation = points.T
    across = distance * np.cos(elevation)
    return np.stack(
        [across * np.cos(azimuth), across * np.sin(azimuth), distance * np.sin(elevation)], axis=-1
    )


def _posed(node: Any, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Moved to the file's frame. Read by name: the order of x, y, z, w in files varies."""
    if not node.isDefined("pose"):
        return points
    pose = node["pose"]
    if pose.isDefined("rotation"):
        w, x, y, z = (pose["rotation"][key].value() for key in "wxyz")
        points = Rotation.from_quat([x, y, z, w]).apply(points)
    if pose.isDefined("translation"):
        points = points + np.array([pose["translation"][key].value() for key in "xyz"])
    return points


def _color_limits(node: Any, prototype: Any) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest value of each channel: as the scan states them, else as its integers are bounded."""
    if node.isDefined("colorLimits"):
        limits = node["colorLimits"]
        ends = [[limits[f"{c}{end}"].value() for c in COLORS] for end in ("Minimum", "Maximum")]
    else:
        ends = [[getattr(prototype[c], end)() for c in COLORS] for end in ("minimum", "maximum")]
    return np.array(ends[0], np.float64), np.array(ends[1], np.float64)


def _eight_bits(rgb: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    span = np.where(high > low, high - low, 1.0)
    return np.clip(np.nan_to_num((rgb - low) / span * 255.0).round(), 0, 255).astype(np.uint8)
