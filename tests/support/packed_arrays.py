"""Arrays of a page or a detail, taken out of its text."""

import base64
import gzip

import numpy as np


def unpacked(text: str) -> bytes:
    """The bytes of a blob."""
    return gzip.decompress(base64.b64decode(text))


def array_of(data: bytes, reference: dict) -> np.ndarray:
    """The integers a reference stands for."""
    return np.frombuffer(
        data, "<" + {"uint16": "u2", "uint32": "u4"}[reference["type"]], reference["count"], reference["at"]
    )


def points_back(data: bytes, reference: dict) -> np.ndarray:
    """The points a reference stands for, (n, 3), meters."""
    return np.array(reference["low"]) + reference["step"] * array_of(data, reference).reshape(-1, 3)
