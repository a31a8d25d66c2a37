"""What every format of scans comes down to."""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Integer

from more2_jax.types import Skipped

# What NumPy and zipfile raise for files that are damaged, encrypted, pickled, or a lone array.
UNREADABLE = (
    ValueError,
    OSError,
    EOFError,
    zipfile.BadZipFile,
    zlib.error,
    TypeError,
    RuntimeError,
    KeyError,
)

CUT_WITHOUT = "--segment changes for two or more scans of one room, --segment geometric for one alone"


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """What the caller knows of a file beyond its format."""

    instance_property: str | None = None  # property of the points that names the instance
    masks: Path | None = None  # predicted masks beside the cloud (Mask3D)
    masks_needed: bool = True  # False: a cloud without masks is welcome, it is segmented afterwards
    depth_frames: bool = False  # points from the raw depth frames rather than from the mesh (3RScan)
    up: str = "z"  # axis that is up in the file: x, y, z, -x, -y or -z


@dataclass(frozen=True, kw_only=True)
class LabeledCloud:
    """Points with the instance they belong to."""

    points: Float[np.ndarray, "n 3"]  # float64, in the file's unit
    instance: Integer[np.ndarray, "n"] | None  # 0 and negative: background; None: the file has no masks
    colors: Integer[np.ndarray, "n 3"] | None = None  # uint8
    # Unit, out of the matter; 0 where a point's is not known. None: the file says nothing.
    normals: Float[np.ndarray, "n 3"] | None = None
    point_labels: np.ndarray | None = None  # (n,) str or integer
    labels: dict[int, str] = field(default_factory=dict)  # instance → label, where the format says it once
    skipped: tuple[Skipped, ...] = ()
    unit: str | None = None  # m, cm or mm where the format fixes it, whatever the caller says
    warnings: tuple[str, ...] = ()
    sensors: Float[np.ndarray, "s 3"] | None = (
        None  # where they stood, as `points`; None: the file does not say
    )
    rows: Bool[np.ndarray, "r"] | None = None  # which rows of the file the points are; None: all

    @property
    def file_rows(self) -> int:
        """Rows of the file, those left out counted: what masks beside it speak of."""
        return len(self.points) if self.rows is None else len(self.rows)


def one_line(error: BaseException) -> str:
    """What an exception says, without line breaks and control characters; its name if it says nothing."""
    text = " ".join(str(error).split()) or type(error).__name__
    return "".join(c if c.isprintable() else "?" for c in text)[:300]


def instance_ids(path: Path, values: Integer[np.ndarray, "n"]) -> Integer[np.ndarray, "n"]:
    """Whole numbers of any type as int64. ValueError, in one line, where they do not fit."""
    if values.dtype.kind == "u" and values.max(initial=0) > np.iinfo(np.int64).max:
        raise ValueError(f"{path}: instance {values.max()} is too large; needed less than 2⁶³")
    return values.astype(np.int64)
