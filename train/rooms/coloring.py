"""What colors things have, and what a camera makes of them: white balance and exposure differ from scan to scan."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

PALETTE = 4  # base colors in a room: several objects share one
SECOND_SHARE = 0.6  # of the models have a second color below some height


def palette(rng: np.random.Generator) -> Float[np.ndarray, "c 3"]:
    """The base colors of a room's furniture: woods, whites, blacks, fabrics."""
    colors = []
    for _ in range(PALETTE):
        hue = rng.choice([rng.uniform(0.05, 0.12), rng.uniform(0, 1)])
        colors.append(colorsys.hsv_to_rgb(hue, rng.uniform(0, 0.6), rng.uniform(0.15, 0.95)))
    return np.array(colors)


def model_colors(
    models: Sequence[str], colors: Float[np.ndarray, "c 3"], rng: np.random.Generator
) -> dict[str, Float[np.ndarray, "3 3"]]:
    """By model: the color above, the color below, and (height share, 0, 0) of the border; copies are colored alike."""
    made: dict[str, np.ndarray] = {}
    for name in dict.fromkeys(models):
        above, below = colors[rng.integers(len(colors), size=2)]
        height = rng.uniform(0.2, 0.7) if rng.random() < SECOND_SHARE else 0.0
        made[name] = np.array([above, below, [height, 0, 0]])
    return made


def face_colors(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], colors: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "f 3"]:
    """The color of each face of a model that stands on z = 0."""
    height = vertices[faces, 2].mean(axis=1) / max(1e-9, float(vertices[:, 2].max()))
    return np.where((height >= colors[2, 0])[:, None], colors[0], colors[1])


@dataclass(frozen=True, kw_only=True)
class Light:
    """How one scan is lit and developed."""

    toward: Float[np.ndarray, " 3"]  # the light
    gain: Float[np.ndarray, " 3"]  # white balance and exposure
    noise: float  # of a pixel, share of full scale

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Light:
        """Another day, another light."""
        toward = np.array([*rng.normal(size=2), rng.uniform(1.0, 2.0)])
        gain = rng.uniform(0.85, 1.15) * rng.uniform(0.92, 1.08, 3)
        return cls(toward=toward / np.linalg.norm(toward), gain=gain, noise=float(rng.uniform(0.01, 0.03)))

    def developed(
        self, albedo: Float[np.ndarray, "p 3"], normals: Float[np.ndarray, "p 3"], rng: np.random.Generator
    ) -> Float[np.ndarray, "p 3"]:
        """Colors of one frame's pixels; its exposure differs a little from its neighbors'."""
        bright = 0.75 + 0.25 * np.abs(normals @ self.toward)
        exposure = rng.uniform(0.95, 1.05)
        image = albedo * bright[:, None] * self.gain * exposure
        return np.clip(image + rng.normal(0, self.noise, image.shape), 0, 1)
