"""Where the cameras of depth views stand; apart from the rendering, whose libraries training does without."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

VIEWS = 24
DISTANCE = 1.6  # of the camera from the center, canonical units
HALF_FIELD = 0.42  # tangent of half the field of view: the whole unit shape is seen


def view_directions(count: int = VIEWS) -> Float[np.ndarray, "count 3"]:
    """Unit directions spread evenly over the sphere (a Fibonacci spiral)."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = np.pi * (1 + 5**0.5) * index
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
