"""Backs and arms of chairs. The seat's front looks along -y; a back stands at its rear edge."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from train.furniture.procedural.parts import (
    BITE,
    Rng,
    bar,
    bent,
    box,
    curved,
    post,
    rounded,
    sheared,
    slab,
    soft_box,
    superellipse,
    tube,
    union,
)

if TYPE_CHECKING:
    from manifold3d import Manifold

# --- backs, upright over y = 0, from z = -BITE to `tall` ------------------------------------------------------


def _stiles(rng: Rng, x: float, tall: float, thick: float) -> list[Manifold]:
    """The two uprights of a back."""
    sides, out = int(rng.choice([4, 12])), x / 2 - thick / 2
    slim = thick * rng.uniform(0.7, 1.0)
    return [post((a * out, 0, -BITE), (a * out, 0, tall), thick, slim, sides) for a in (-1, 1)]


def slats(rng: Rng, x: float, tall: float, thick: float) -> list[Manifold]:
    """Upright slats between two rails."""
    count, width = int(rng.integers(3, 7)), rng.uniform(0.02, 0.05)
    width = min(width, 0.7 * x / (count + 1))
    low, high, deep = rng.uniform(0.02, 0.35) * tall, tall - rng.uniform(0.0, 0.03), max(0.012, 0.4 * thick)
    rail = rng.uniform(0.035, 0.08)
    inner = x - thick
    parts = [*_stiles(rng, x, tall, thick), box(inner, deep * 1.4, rail, (0, 0, high - rail))]
    parts.append(box(inner, deep * 1.4, 0.035, (0, 0, low)))
    middles = np.linspace(-inner / 2, inner / 2, count + 2)[1:-1]
    return [*parts, *(box(width, deep, high - low - 0.04, (float(m), 0, low + 0.02)) for m in middles)]


def ladder(rng: Rng, x: float, tall: float, thick: float) -> list[Manifold]:
    """Two to five level rungs, straight or bowed."""
    count, inner = int(rng.integers(2, 6)), x - 0.8 * thick
    width, bow = min(rng.uniform(0.03, 0.1), 0.6 * tall / count), rng.choice([0.0, rng.uniform(0.015, 0.04)])
    heights = np.linspace(rng.uniform(0.15, 0.4) * tall, tall - width - rng.uniform(0, 0.03), count)
    rungs = [slab(rounded(inner, width, 0.4 * width), 0.016).rotate((90, 0, 0)) for _ in heights]
    rungs = [
        curved(r.translate((0, 0.008, 0)), bow, inner) if bow else r.translate((0, 0.008, 0)) for r in rungs
    ]
    parts = [r.translate((0, 0, float(h) + width / 2)) for r, h in zip(rungs, heights, strict=True)]
    return [*_stiles(rng, x, tall, thick), *parts]


def spindles(rng: Rng, x: float, tall: float, thick: float) -> list[Manifold]:
    """A row of thin rods under a bowed or straight crest, as Windsor chairs have."""
    count, radius = int(rng.integers(5, 10)), rng.uniform(0.005, 0.008)
    flare = rng.uniform(0.85, 1.1)
    crest = max(0.012, 0.35 * thick)
    feet = np.linspace(-0.44 * x, 0.44 * x, count)
    if rng.random() < 0.5:  # a hoop that ends in the seat
        angles = np.linspace(0, np.pi, 12)
        half, rise = 0.46 * x, tall - crest
        hoop = [(half * np.cos(a), 0.0, rise * np.sin(a) ** 0.7 - 0.5 * BITE) for a in angles]
        reach = rise * (1 - (feet / half) ** 2) ** 0.35
        parts = [tube(hoop, crest)]
        spread = 1.0
    else:
        ends = [(a * 0.5 * x * flare, 0.0, tall - crest) for a in (-1, 1)]
        parts, reach, spread = [bar(ends[0], ends[1], crest)], np.full(count, tall - crest), flare
        count_out = [bar((a * 0.47 * x, 0, 0), e, 1.6 * radius) for a, e in zip((-1, 1), ends, strict=True)]
        parts += count_out
    rods = [bar((f, 0, -0.002), (f * spread, 0, float(r)), radius) for f, r in zip(feet, reach, strict=True)]
    return [*parts, *rods]


def panel(rng: Rng, x: float, tall: float, thick: float) -> list[Manifold]:
    """One board: rectangular, round-cornered or oval, bowed or flat, with a slot for the hand or a gap below."""
    low = rng.choice([-BITE, rng.uniform(0.15, 0.4) * tall])
    board, rise = rng.uniform(0.012, 0.025), tall - low
    oval = rng.random() < 0.3
    outline = superellipse(x, rise, rng.uniform(2.3, 4)) if oval else rounded(x, rise, rng.uniform(0, 0.12))
    solid = slab(outline, board).rotate((90, 0, 0)).translate((0, board / 2, low + rise / 2))
    if rng.random() < 0.3:
        hole = box(0.3 * x, 0.2, rng.uniform(0.03, 0.06), (0, 0, low + rise * rng.uniform(0.7, 0.78)))
        solid = solid - hole
    bow = rng.choice([0.0, rng.uniform(0.02, 0.06)])
    parts = [curved(solid, bow, x) if bow else solid]
    if low > 0 or oval:  # stays, behind the board where it is bowed
        out, width = 0.28 * x, rng.uniform(0.025, 0.04)
        deep = bow * (1 - 0.56**2)
        stays = [
            post((a * out, deep * 0.5, -BITE), (a * out, deep, low + 0.5 * rise), width, 0.022)
            for a in (-1, 1)
        ]
        parts += stays
    return parts


def padded(rng: Rng, x: float, tall: float, thick: float) -> list[Manifold]:
    """An upholstered back."""
    deep, radius = rng.uniform(0.04, 0.08), rng.uniform(0.015, 0.035)
    low = rng.choice([-BITE, rng.uniform(0.12, 0.25) * tall])
    solid = soft_box(x, deep, tall - low, (0, 0, low), radius)
    bow = rng.choice([0.0, rng.uniform(0.02, 0.06)])
    parts = [curved(solid, bow, x) if bow else solid]
    if low > 0:
        out = 0.3 * x
        parts += [box(0.03, 0.025, low + 0.1, (a * out, bow * 0.6, -BITE)) for a in (-1, 1)]
    return parts


def frame(rng: Rng, x: float, tall: float, thick: float) -> list[Manifold]:
    """A hoop of bent tube with a pad or a lattice in it."""
    radius, out = rng.uniform(0.009, 0.014), x / 2
    path = [(-out, 0, -BITE / 2), (-out, 0, tall - radius), (out, 0, tall - radius), (out, 0, -BITE / 2)]
    parts = [tube(bent(path, rng.uniform(0.03, 0.12)), radius)]
    low = rng.uniform(0.2, 0.5) * tall
    if rng.random() < 0.6:
        return [*parts, soft_box(x, 0.03, 0.85 * tall - low, (0, 0, low), 0.012)]
    heights = np.linspace(low, 0.85 * tall, int(rng.integers(2, 5)))
    return [*parts, *(bar((-out, 0, float(h)), (out, 0, float(h)), 0.7 * radius) for h in heights)]


BACKS: dict[str, Callable[[Rng, float, float, float], list[Manifold]]] = {
    "slats": slats,
    "ladder": ladder,
    "spindles": spindles,
    "panel": panel,
    "padded": padded,
    "frame": frame,
}


def back(rng: Rng, x: float, tall: float, thick: float, style: str, at: tuple[float, float]) -> Manifold:
    """A back of one of `BACKS`, x wide, that rises from the seat's top at (y, z) = `at` and leans backwards."""
    solid = union(BACKS[style](rng, x, tall, thick))
    return sheared(solid, rng.uniform(0.05, 0.25), 0.0).translate((0, at[0], at[1]))


# --- arms ---------------------------------------------------------------------------------------------------


def arms(rng: Rng, x: float, y: float, seat: float, rear: float) -> list[Manifold]:
    """Two armrests outside a seat x × y whose top is at `seat`: boards on posts, loops of tube, or pads.

    They run from the front to `rear`, where they meet the back.
    """
    rise, out = rng.uniform(0.18, 0.25), x / 2
    front, style = -y / 2 + rng.uniform(0.02, 0.12), rng.choice(["board", "loop", "pad"])
    parts = []
    for a in (-1, 1):
        across = a * out
        if style == "loop":
            radius = rng.uniform(0.010, 0.015)
            low = seat - 0.02
            path = [(across, front + 0.03, low), (across, front, seat + rise), (across, rear, seat + rise)]
            path = [(a * (out - 0.06), front + 0.05, low), *path]
            parts.append(tube(bent(path, 0.05), radius))
        elif style == "board":
            wide = 0.05
            top = slab(rounded(wide, rear - front + 0.05, 0.02), 0.022)
            parts.append(top.translate((across, (front + rear) / 2, seat + rise - 0.011)))
            stand = front + 0.06
            parts.append(
                post((a * (out - 0.04), stand, seat - 0.025), (across, stand, seat + rise), 0.028, 0.028)
            )
        else:
            pad = soft_box(0.07, rear - front, 0.045, (across, (front + rear) / 2, seat + rise - 0.02), 0.018)
            parts += [pad, box(0.05, 0.04, rise + 0.03, (a * (out - 0.02), front + 0.1, seat - 0.03))]
    return parts
