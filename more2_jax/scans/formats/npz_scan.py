"""An NPZ with `points` (n, 3), `instance` (n,) and optional `label`, `color`, `normal`, and where sensors stood."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from more2_jax.scans.files.npz import read_arrays
from more2_jax.scans.files.ply_faces import unit_or_zero
from more2_jax.scans.labeled_cloud import CUT_WITHOUT, LabeledCloud, ReadOptions, instance_ids

COLORS = ("color", "colors")  # the first that is there
NORMALS = ("normal", "normals")  # the first that is there
SENSORS, CAMERAS = "sensors", "T_scan_camera"  # places (s, 3), or poses (s, 4, 4) of cameras in the scan
HOW = f" (name the instances with --instance-property, or cut the scan without: {CUT_WITHOUT})"


def recognizes(path: Path) -> bool:
    """Whether this is an NPZ file, by its suffix."""
    return path.is_file() and path.suffix.lower() == ".npz"


def read(path: Path, options: ReadOptions) -> LabeledCloud:
    key = options.instance_property or "instance"
    arrays, names = read_arrays(path, ("points", key, "label", *COLORS, *NORMALS, SENSORS, CAMERAS))
    segmented = not options.masks_needed and options.instance_property is None
    if missing := [k for k in ("points", *((key,) if not segmented else ())) if k not in arrays]:
        raise ValueError(f"{path}: arrays are {names}; needed {' and '.join(missing)} too" + HOW)
    _check_npz(path, arrays, key)
    labels = arrays.get("label") if key != "label" else None
    return LabeledCloud(
        points=arrays["points"].astype(np.float64),
        instance=instance_ids(path, arrays[key]) if key in arrays else None,
        colors=_colors(next((arrays[k] for k in COLORS if k in arrays), None)),
        normals=next((unit_or_zero(arrays[k]) for k in NORMALS if k in arrays), None),
        point_labels=labels,
        sensors=_sensors(arrays),
    )


def _check_npz(path: Path, arrays: dict[str, np.ndarray], key: str) -> None:
    points, count = arrays["points"], len(np.atleast_1d(arrays["points"]))
    needed = {"points": ((count, 3), "iuf"), key: ((count,), "iu")}
    needed |= dict.fromkeys((*COLORS, *NORMALS), ((count, 3), "iuf"))
    needed |= {"label": ((count,), "iuUS")} if key != "label" else {}
    for name, each in ((SENSORS, (3,)), (CAMERAS, (4, 4))):
        needed[name] = ((len(np.atleast_1d(arrays.get(name, ()))), *each), "iuf")
    if points.ndim != 2:
        raise ValueError(f"{path}: points have shape {points.shape}; needed (n, 3)")
    for name, (shape, kinds) in needed.items():
        array = arrays.get(name)
        if array is not None and array.shape != shape:
            raise ValueError(f"{path}: {name} has shape {array.shape}; needed {shape}")
        if array is not None and array.dtype.kind not in kinds:
            raise ValueError(f"{path}: {name} holds {array.dtype}; needed {_kinds_in_words(kinds)}")


def _sensors(arrays: dict[str, np.ndarray]) -> np.ndarray | None:
    if SENSORS in arrays:
        return arrays[SENSORS].astype(np.float64)
    return arrays[CAMERAS][:, :3, 3].astype(np.float64) if CAMERAS in arrays else None


def _kinds_in_words(kinds: str) -> str:
    words = {"iu": "integers", "iuf": "numbers", "iuUS": "integers or strings"}
    return words[kinds]


def _colors(colors: np.ndarray | None) -> np.ndarray | None:
    if colors is None:
        return None
    return np.clip(colors * 255.0 if colors.dtype.kind == "f" else colors, 0, 255).astype(np.uint8)
