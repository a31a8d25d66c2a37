"""Drawers, doors and their handles. A front looks along -y."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from train.furniture.procedural.parts import BITE, Rng, bar, box, turned, union

if TYPE_CHECKING:
    from manifold3d import Manifold

FRONT, GAP = 0.018, 0.004  # thickness of a front, distance between two


def drawers(
    rng: Rng, x: float, y: float, z: float, rows: int, across: int = 1, plinth: float = 0.0
) -> Manifold:
    """A chest x × y × z, standing on z = 0, with a grid of drawers; the heights of its rows differ."""
    carcass = box(x, y - FRONT, z, (0, FRONT / 2, 0))
    shares = np.cumsum(rng.uniform(0.7, 1.3, rows))
    levels = plinth + (z - plinth) * np.concatenate([[0], shares / shares[-1]])
    edges, style = np.linspace(-x / 2, x / 2, across + 1), handle_style(rng)
    fronts = [
        front(lo, hi, bottom, top, y, style, (0.5, 0.5 if style != "cup" else 0.7))
        for lo, hi in itertools.pairwise(edges)
        for bottom, top in itertools.pairwise(levels)
    ]
    return union([carcass, *fronts])


def front(
    left: float, right: float, low: float, high: float, y: float, style: str, at: tuple[float, float]
) -> Manifold:
    """A door or a drawer's front on a carcass y deep, with its handle at the shares `at` of width and height."""
    x, z = right - left - GAP, high - low - GAP
    middle, base = (left + right) / 2, low + GAP / 2
    face = -y / 2
    board = box(x, FRONT + BITE, z, (middle, face + (FRONT + BITE) / 2, base))
    spot = (left + GAP / 2 + at[0] * x, base + at[1] * z)
    tall = at[0] != 0.5  # a door has its handle upright, on one side
    if style == "slot":
        size = (0.03, 0.1) if tall else (min(0.12, 0.5 * x), min(0.025, 0.3 * z))
        return board - box(size[0], 0.022, min(size[1], 0.5 * z), (spot[0], face, spot[1] - size[1] / 2))
    return union([board, *_handle(style, spot, face, 0.16 * (z if tall else x), tall)])


def handle_style(rng: Rng) -> str:
    """How the fronts of one piece are pulled: bars, knobs, cups, slots or nothing to see."""
    return str(rng.choice(["bar", "bar", "knob", "cup", "slot", "none"]))


def _handle(style: str, at: tuple[float, float], face: float, length: float, tall: bool) -> list[Manifold]:
    """A handle on the front's plane y = `face`, its middle at (x, z) = `at`."""
    if style == "none":
        return []
    if style == "knob":
        profile = [(0, 0), (0.007, 0), (0.006, 0.015), (0.014, 0.02), (0.014, 0.028), (0, 0.032)]
        return [turned(profile).rotate((90, 0, 0)).translate((at[0], face + 0.003, at[1]))]
    if style == "cup":
        return [box(0.08, 0.024, 0.03, (at[0], face - 0.008, at[1] - 0.015))]
    half = float(np.clip(length, 0.04, 0.16))
    ends = [(at[0], at[1] + s * half) if tall else (at[0] + s * half, at[1]) for s in (-1, 1)]
    out = face - 0.028
    parts = [bar((ends[0][0], out, ends[0][1]), (ends[1][0], out, ends[1][1]), 0.0055)]
    return [*parts, *(bar((e[0], face + 0.004, e[1]), (e[0], out, e[1]), 0.005) for e in ends)]
