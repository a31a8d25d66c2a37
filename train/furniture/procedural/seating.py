"""Seats for one: chairs, stools, office chairs; and benches."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from train.furniture.procedural.backs import BACKS, arms, back
from train.furniture.procedural.parts import (
    BITE,
    Outline,
    Rng,
    bar,
    bent,
    box,
    curved,
    cushion,
    pole,
    post,
    rounded,
    sheared,
    slab,
    soft_box,
    superellipse,
    tube,
)
from train.furniture.procedural.supports import four_legs, panels, pedestal, sled, star, trestles

if TYPE_CHECKING:
    from manifold3d import Manifold


def _seat(rng: Rng, x: float, y: float, top: float) -> tuple[list[Manifold], float]:
    """A chair's seat up to the height `top`, and the height of its underside: a board or an upholstered pad."""
    if rng.random() < 0.5:
        thick = rng.uniform(0.02, 0.04)
        outline = rounded(x, y, rng.uniform(0, 0.08)) if rng.random() < 0.6 else superellipse(x, y, 4)
        return [slab(_narrowed(outline, rng.uniform(0, 0.1)), thick, (0, 0, top - thick), 0.006)], top - thick
    thick, board = rng.uniform(0.035, 0.07), 0.018
    pad = soft_box(x, y, thick, (0, 0, top - thick), rng.uniform(0.015, 0.03))
    plate = slab(rounded(0.95 * x, 0.95 * y, 0.02), board + BITE, (0, 0, top - thick - board))
    return [pad, plate], top - thick - board


def _narrowed(outline: Outline, share: float) -> Outline:
    """Narrower toward the back (+y), by that share at the rear edge."""
    depth = (outline[:, 1] - outline[:, 1].min()) / np.ptp(outline[:, 1])
    return outline * np.column_stack([1 - share * depth, np.ones(len(depth))])


def chair(rng: Rng) -> list[Manifold]:
    """A side or arm chair: backs of six styles, seat of wood or padded, legs, sled, cantilever, pedestal, star."""
    x, y, top = rng.uniform(0.38, 0.5), rng.uniform(0.38, 0.48), rng.uniform(0.42, 0.48)
    parts, under = _seat(rng, x, y, top)
    thick = rng.uniform(0.028, 0.045)
    base = rng.choice(["legs", "sled", "cantilever", "pedestal", "star"], p=[0.62, 0.12, 0.1, 0.08, 0.08])
    if base == "legs":
        parts += four_legs(rng, 0.88 * x, 0.92 * y, under, thick, rungs=0.45)
    elif base == "sled":
        parts += sled(rng, 0.94 * x, y, under + BITE, rng.uniform(0.018, 0.026))
    elif base == "cantilever":
        parts += _cantilever(0.92 * x, y, under, rng.uniform(0.011, 0.014))
    elif base == "pedestal":
        parts += pedestal(rng, rng.uniform(0.42, 0.52), under)
    else:
        parts += star(rng, rng.uniform(0.26, 0.32), under, castors=False)
    if base in ("pedestal", "star"):  # a plate that carries the seat
        parts.append(pole(0.13, 0.02, (0, 0, under - 0.02 + BITE)))
    tall, style = rng.uniform(0.32, 0.58), str(rng.choice(list(BACKS)))
    wide, rear = rng.uniform(0.78, 0.86) * x, y / 2 - rng.uniform(0.03, 0.045)
    parts.append(back(rng, wide, tall, thick, style, (rear, top)))
    if rng.random() < 0.3:
        parts += arms(rng, x, y, top, rear + 0.05)
        parts += _joints(x, wide, rear, top)
    return parts


def _joints(x: float, wide: float, rear: float, top: float) -> list[Manifold]:
    """Short rails that tie the armrests' rear ends down to the seat."""
    return [
        post((a * (x / 2 - 0.06), rear, top - 0.02), (a * x / 2, rear + 0.03, top + 0.2), 0.024, 0.024, 12)
        for a in (-1, 1)
    ]


def _cantilever(x: float, y: float, height: float, radius: float) -> list[Manifold]:
    """Two C of bent tube that carry the seat from the front, joined behind on the floor."""
    out, front, rear = x / 2 - radius, -y / 2 + radius, y / 2 - radius
    path = [(-out, rear, height), (-out, front, height), (-out, front, radius), (-out, rear, radius)]
    mirrored = [(-p[0], p[1], p[2]) for p in reversed(path)]
    return [tube(bent([*path, *mirrored], 0.08), radius)]


def stool(rng: Rng) -> list[Manifold]:
    """A round, square or saddled seat at sitting or bar height, on legs, on three legs, a foot or a star."""
    top, width = rng.choice([rng.uniform(0.38, 0.5), rng.uniform(0.58, 0.8)]), rng.uniform(0.28, 0.42)
    deep, thick = width * rng.choice([1.0, rng.uniform(0.75, 1.0)]), rng.uniform(0.025, 0.08)
    under, is_round = top - thick, rng.random() < 0.5
    outline = superellipse(width, deep, 2) if is_round else rounded(width, deep, rng.uniform(0, 0.08))
    seat = slab(outline, thick, (0, 0, under), rng.uniform(0, 0.012))
    if rng.random() < 0.3:
        seat = (
            soft_box(width, deep, thick, (0, 0, under), 0.03)
            if not is_round
            else cushion(width, deep, thick, (0, 0, under), 2, 5)
        )
    parts, base = [seat], rng.choice(["four", "three", "pedestal", "star"], p=[0.5, 0.2, 0.2, 0.1])
    inner = 0.72 if is_round else 0.95
    if base == "four":
        parts += four_legs(rng, inner * width, inner * deep, under, rng.uniform(0.026, 0.045), rungs=0.8)
    elif base == "three":
        parts += _three_legs(rng, 0.36 * min(width, deep), under)
    elif base == "pedestal":
        parts += pedestal(rng, rng.uniform(0.36, 0.44), under)
    else:
        parts += star(rng, rng.uniform(0.22, 0.28), under, castors=rng.random() < 0.7)
    if base in ("star", "pedestal"):
        parts.append(pole(0.4 * min(width, deep), 0.02, (0, 0, under - 0.014)))
    if rng.random() < 0.25:
        outer = 0.8 * width
        parts.append(back(rng, outer, rng.uniform(0.12, 0.25), 0.03, "panel", (0.32 * deep, top - 0.008)))
    return parts


def _three_legs(rng: Rng, reach: float, height: float) -> list[Manifold]:
    """Three splayed legs, with bars between them or without."""
    thick, splay = rng.uniform(0.026, 0.04), rng.uniform(0.03, 0.12)
    angles = 2 * np.pi * np.arange(3) / 3 + np.pi / 2
    plan = np.column_stack([np.cos(angles), np.sin(angles)])
    feet = [(*((reach + splay) * p), 0.0) for p in plan]
    heads = [(*(reach * p), height + BITE) for p in plan]
    parts = [post(f, h, 0.75 * thick, thick, 16) for f, h in zip(feet, heads, strict=True)]
    if rng.random() < 0.6:
        share = rng.uniform(0.25, 0.5)
        spots = [
            tuple((1 - share) * np.array(f) + share * np.array(h)) for f, h in zip(feet, heads, strict=True)
        ]
        parts += [bar(spots[k], spots[k - 1], 0.009) for k in range(3)]
    return parts


def office_chair(rng: Rng) -> list[Manifold]:
    """A swivel chair on a star with castors; back high or low, often bowed; armrests and headrest, or none."""
    x, y, top = rng.uniform(0.44, 0.54), rng.uniform(0.42, 0.5), rng.uniform(0.43, 0.54)
    thick = rng.uniform(0.05, 0.09)
    under = top - thick
    parts = [cushion(x, y, thick, (0, 0, under), rng.uniform(4, 7), rng.uniform(2.5, 4))]
    parts += star(rng, rng.uniform(0.27, 0.34), under, castors=True)
    parts.append(box(0.2, 0.26, 0.05, (0, 0.02, under - 0.03)))
    rear, tall = y / 2 + rng.uniform(0.0, 0.03), rng.uniform(0.35, 0.72)
    low, deep = rng.uniform(0.04, 0.16), rng.uniform(0.03, 0.07)
    wide, bow, lean = x * rng.uniform(0.8, 1.0), rng.uniform(0.0, 0.07), rng.uniform(0.05, 0.2)
    end = rear + bow + deep / 2
    support = [box(0.07, end, 0.025, (0, end / 2, under - 0.02))]
    support.append(box(0.07, 0.022, low + thick + 0.25, (0, end, under - 0.02)))
    if rng.random() < 0.5:
        cover = soft_box(wide, deep, tall, (0, 0, 0), rng.uniform(0.015, 0.03))
    else:
        flat = superellipse(wide, tall, rng.uniform(2.6, 5))
        cover = slab(flat, deep, (0, 0, 0), 0.01).rotate((90, 0, 0)).translate((0, deep / 2, tall / 2))
    rest = [curved(cover, bow, wide).translate((0, rear, top + low))]
    if rng.random() < 0.35:
        head = soft_box(0.6 * wide, 0.06, 0.14, (0, rear + bow, top + low + tall + 0.03), 0.025)
        rest += [head, box(0.05, 0.022, 0.12, (0, rear + bow, top + low + tall - 0.04))]
    parts += [sheared(part, lean, top) for part in (*support[1:], *rest)]
    parts.append(support[0])
    if rng.random() < 0.7:
        parts += _office_arms(rng, x, y, top, under)
    return parts


def _office_arms(rng: Rng, x: float, y: float, top: float, under: float) -> list[Manifold]:
    """T-shaped armrests on a bracket below the seat."""
    rise, out, wide = rng.uniform(0.18, 0.25), x / 2 + 0.035, rng.uniform(0.06, 0.09)
    parts = [box(2 * out + 0.03, 0.06, 0.02, (0, 0, under - 0.012))]
    for a in (-1, 1):
        parts.append(box(0.03, 0.06, top + rise - under + 0.02, (a * out, 0, under - 0.012)))
        pad = soft_box(wide, rng.uniform(0.22, 0.3), 0.035, (a * out, -0.01, top + rise - 0.005), 0.014)
        parts.append(pad)
    return parts


def bench(rng: Rng) -> list[Manifold]:
    """A long seat, solid, slatted or padded, on legs, panels, trestles or sleds; with a back and arms or without."""
    x, y, top = rng.uniform(0.9, 1.8), rng.uniform(0.3, 0.5), rng.uniform(0.38, 0.5)
    thick = rng.uniform(0.03, 0.06)
    under = top - thick
    style = rng.choice(["board", "slats", "padded"])
    if style == "board":
        parts = [slab(rounded(x, y, rng.uniform(0, 0.1)), thick, (0, 0, under), rng.uniform(0, 0.01))]
    elif style == "padded":
        parts = [box(x, y, thick, (0, 0, under)), soft_box(x, y, 0.07, (0, 0, top - BITE), 0.028)]
        if rng.random() < 0.5:
            parts.append(box(0.94 * x, 0.85 * y, 0.08, (0, 0, under - 0.07)))
    else:
        count = int(rng.integers(3, 7))
        width = y / count * rng.uniform(0.7, 0.88)
        middles = np.linspace(-y / 2 + width / 2, y / 2 - width / 2, count)
        parts = [box(x, width, 0.5 * thick + 0.01, (0, float(m), top - 0.5 * thick - 0.01)) for m in middles]
        parts += [box(0.05, y, 0.6 * thick, (a * 0.4 * x, 0, under)) for a in (-1, 0, 1)]
    parts += _bench_base(rng, x, y, under + (0.3 * thick if style == "slats" else 0), style == "slats")
    if rng.random() < 0.5:
        parts += _bench_back(rng, x, y, top)
    return parts


def _bench_base(rng: Rng, x: float, y: float, under: float, slatted: bool) -> list[Manifold]:
    """Legs, panels, trestles or sleds, under the bearers of a slatted seat."""
    style = rng.choice(["legs", "panels", "trestles", "sled"])
    if slatted:  # the slats' outer bearers are at 0.4 x
        thick = rng.uniform(0.045, 0.06)
        return [part for part in four_legs(rng, 0.8 * x + thick, y, under, thick)] + [
            box(0.8 * x, thick, 0.05, (0, b * (y / 2 - 0.8 * thick), under - 0.05)) for b in (-1, 1)
        ]
    if style == "legs":
        return four_legs(rng, 0.95 * x, 0.95 * y, under, rng.uniform(0.04, 0.08), rungs=0.3)
    if style == "panels":
        return panels(rng, x, y, under, rng.uniform(0.025, 0.05))
    if style == "trestles":
        return trestles(rng, x, y, under, rng.uniform(0.04, 0.07))
    return sled(rng, 0.92 * x, 0.95 * y, under + BITE, rng.uniform(0.03, 0.05))


def _bench_back(rng: Rng, x: float, y: float, top: float) -> list[Manifold]:
    """Posts with boards, upright slats or one panel; perhaps arms."""
    tall, lean = rng.uniform(0.3, 0.5), rng.uniform(0.0, 0.2)
    rear, count = y / 2 - 0.03, int(rng.integers(2, 5))
    posts = [box(0.05, 0.04, tall + 0.03, (a * 0.4 * x, rear, top - 0.03)) for a in (-1, 0, 1)]
    if rng.random() < 0.5:
        board = 0.7 * tall / count
        lows = np.linspace(0.2 * tall, tall - board, count)
        boards = [box(x, 0.025, board, (0, rear - 0.02, top + float(low))) for low in lows]
    else:
        spots = np.linspace(-0.46 * x, 0.46 * x, int(rng.integers(8, 18)))
        boards = [box(x, 0.04, 0.06, (0, rear, top + tall - 0.03)), box(x, 0.03, 0.05, (0, rear, top + 0.06))]
        boards += [box(0.03, 0.018, tall - 0.06, (float(s), rear, top + 0.07)) for s in spots]
    parts = [sheared(part, lean, top) for part in (*posts, *boards)]
    if rng.random() < 0.5:
        for a in (-1, 1):
            across = a * 0.4 * x
            parts.append(slab(rounded(0.06, y, 0.02), 0.03, (across, 0.02, top + 0.2)))
            parts.append(box(0.045, 0.045, 0.24, (across, -y / 2 + 0.06, top - 0.03)))
    return parts
