"""Arrays of a page in one stretch of text: quantized to 16 bit, joined, deflated, base64."""

from __future__ import annotations

import base64
import gzip
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

LEVELS = 65535  # steps of 16 bit


@dataclass
class Blob:
    """Collects arrays; every array is known by where it begins, how long it is and its type."""

    _parts: list[bytes] = field(default_factory=list)
    _size: int = 0

    def add(self, array: np.ndarray) -> dict[str, Any]:
        """Appends an array of uint16 or uint32 and returns the reference that the page resolves."""
        if array.dtype not in (np.uint16, np.uint32):
            raise ValueError(f"array of {array.dtype}; needed uint16 or uint32")
        data = np.ascontiguousarray(array.astype(array.dtype.newbyteorder("<"))).tobytes()
        reference = {"at": self._size, "count": int(array.size), "type": array.dtype.name}
        padding = -len(data) % 4  # typed arrays of the page begin at multiples of their item's size
        self._parts.append(data + bytes(padding))
        self._size += len(data) + padding
        return reference

    def add_points(self, points: Float[np.ndarray, "n 3"]) -> dict[str, Any]:
        """Appends points, meters, on a grid of 65,536 steps along the longest side of their box.

        The reference says how to have them back: `low + step * integers`.
        """
        low = points.min(axis=0) if len(points) else np.zeros(3)
        longest = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
        step = max(longest / LEVELS, 1e-9)
        grid = np.rint((points - low) / step).astype(np.uint16)
        return self.add(grid) | {"low": low.tolist(), "step": step}

    def text(self) -> str:
        """All of it as base64 of gzip; the same bytes for the same arrays."""
        return base64.b64encode(gzip.compress(b"".join(self._parts), 6, mtime=0)).decode("ascii")
