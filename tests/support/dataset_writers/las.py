"""LAS 1.4 and LAZ with extra-bytes dimensions."""

from pathlib import Path

import laspy
import numpy as np


def write_las(
    path: Path, points: np.ndarray, colors: np.ndarray | None = None, *, scale=1e-4, offset=None, **extra
) -> Path:
    """The suffix chooses between LAS and LAZ. `extra`: dimension → (n,) values of any integer or float type."""
    header = laspy.LasHeader(point_format=7 if colors is not None else 6, version="1.4")
    header.scales, header.offsets = np.full(3, scale), np.zeros(3) if offset is None else np.asarray(offset)
    for name, values in extra.items():
        header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=values.dtype))
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    if colors is not None:
        las.red, las.green, las.blue = colors.T
    for name, values in extra.items():
        las[name] = values
    las.write(str(path))
    return path
