"""Cabinets and shelves."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from train.furniture.procedural.fronts import FRONT, front, handle_style
from train.furniture.procedural.parts import BITE, Rng, bar, between, box, post, rounded, slab, union
from train.furniture.procedural.supports import four_legs

if TYPE_CHECKING:
    from manifold3d import Manifold

SIZES = {  # width, depth, height (m), lowest and highest
    "bedside": ((0.35, 0.55), (0.3, 0.45), (0.42, 0.65)),
    "chest": ((0.6, 1.2), (0.4, 0.52), (0.75, 1.25)),
    "sideboard": ((1.2, 2.0), (0.38, 0.5), (0.6, 0.9)),
    "television": ((1.2, 2.0), (0.35, 0.45), (0.38, 0.58)),
    "wardrobe": ((0.8, 1.8), (0.5, 0.62), (1.8, 2.2)),
    "tall": ((0.4, 0.7), (0.35, 0.45), (1.4, 2.0)),
}


def cabinet(rng: Rng) -> list[Manifold]:
    """Bedside, chest, sideboard, television bench, wardrobe, tall cabinet: columns of doors, drawers, open bays."""
    size = SIZES[str(rng.choice(list(SIZES)))]
    x, y, top = (rng.uniform(*span) for span in size)
    parts, low = _foot(rng, x, y, top)
    board, tall = rng.uniform(0.016, 0.026), top - low
    parts.append(box(x, y - FRONT, tall, (0, FRONT / 2, low)))
    if rng.random() < 0.5:  # a top that overhangs
        over = rng.uniform(0.0, 0.025)
        outline = rounded(x + 2 * over, y + over, rng.choice([0.0, 0.02]))
        parts.append(slab(outline, board, (0, -over / 2, top - BITE), rng.choice([0.0, 0.008])))
    columns = max(1, round(x / rng.uniform(0.38, 0.65)))
    edges = _divided(rng, -x / 2, x / 2, columns)
    style, holes = handle_style(rng), []
    symmetric = rng.random() < 0.5
    kinds = [
        str(rng.choice(["door", "drawers", "open", "mixed"], p=[0.4, 0.3, 0.12, 0.18])) for _ in edges[1:]
    ]
    for k, (left, right) in enumerate(itertools.pairwise(edges)):
        kind = kinds[min(k, len(kinds) - 1 - k)] if symmetric else kinds[k]
        added, cut = _column(rng, (left, right, low, top), y, kind, style, board)
        parts += added
        holes += cut
    return _carved(parts, holes)


def _carved(parts: list[Manifold], holes: list[Manifold]) -> list[Manifold]:
    """The parts with the holes taken from each of them."""
    return [union(parts) - union(holes)] if holes else parts


def _divided(rng: Rng, low: float, high: float, count: int) -> list[float]:
    """`count` + 1 edges from low to high, evenly or not."""
    shares = np.cumsum(rng.uniform(0.75, 1.3, count) if rng.random() < 0.4 else np.ones(count))
    return [low, *(low + (high - low) * shares / shares[-1]).tolist()]


def _foot(rng: Rng, x: float, y: float, top: float) -> tuple[list[Manifold], float]:
    """Legs, a plinth that stands back, a sled of bars, or nothing; and the height of the body above."""
    style = rng.choice(["legs", "plinth", "bars", "floor"], p=[0.4, 0.25, 0.15, 0.2])
    if style == "floor" or (top > 1.4 and style == "bars"):
        return [], 0.0
    low = rng.uniform(0.05, 0.1) if style == "plinth" or top > 1.4 else rng.uniform(0.08, 0.22)
    if style == "plinth":
        return [box(x - 0.04, y - 0.06, low + BITE, (0, 0.02, 0))], low
    if style == "legs":
        return four_legs(rng, 0.97 * x, 0.95 * y, low, rng.uniform(0.03, 0.055)), low
    parts, thick = [], 0.025
    for a in (-1, 1):
        parts.append(box(thick, 0.9 * y, thick, (a * 0.42 * x, 0, 0)))
        parts += [box(thick, thick, low + BITE, (a * 0.42 * x, b * 0.42 * y, 0)) for b in (-1, 1)]
    return parts, low


def _column(
    rng: Rng, bay: tuple[float, float, float, float], y: float, kind: str, style: str, board: float
) -> tuple[list[Manifold], list[Manifold]]:
    """One column's fronts, and the holes of its open bays; `bay` is left, right, low, high."""
    left, right, low, high = bay
    if kind == "mixed":
        middle = low + (high - low) * rng.uniform(0.35, 0.65)
        above, holes = _column(
            rng, (left, right, middle, high), y, str(rng.choice(["drawers", "open"])), style, board
        )
        below, more = _column(
            rng, (left, right, low, middle), y, str(rng.choice(["door", "drawers"])), style, board
        )
        return [*above, *below], [*holes, *more]
    if kind == "open":
        return _open_bay(rng, bay, y, board)
    if kind == "drawers":
        rows = int(np.clip(round((high - low) / rng.uniform(0.16, 0.28)), 1, 6))
        levels = _divided(rng, low, high, rows)
        return [front(left, right, a, b, y, style, (0.5, 0.5)) for a, b in itertools.pairwise(levels)], []
    pair = right - left > rng.uniform(0.5, 0.65)
    edges = [left, (left + right) / 2, right] if pair else [left, right]
    inner = min(0.05 / (edges[1] - edges[0]), 0.25)
    side = [1 - inner, inner] if pair else [float(rng.choice([inner, 1 - inner]))]
    up = 0.5 if high - low > 1.2 else rng.uniform(0.6, 0.85)
    doors = zip(edges, edges[1:], side, strict=False)
    return [front(a, b, low, high, y, style, (s, up)) for a, b, s in doors], []


def _open_bay(
    rng: Rng, bay: tuple[float, float, float, float], y: float, board: float
) -> tuple[list[Manifold], list[Manifold]]:
    """Compartments without a front: a frame flush with the fronts, and what is hollow of it."""
    left, right, low, high = bay
    whole = between((left, -y / 2, low), (right, -y / 2 + FRONT + BITE, high))
    rows = max(1, round((high - low) / rng.uniform(0.25, 0.4)))
    levels = _divided(rng, low + board / 2, high - board / 2, rows)
    half = board / 2
    holes = [
        between((left + board, -y / 2 - 1, a + half), (right - board, y / 2 - 0.012, b - half))
        for a, b in itertools.pairwise(levels)
    ]
    return [whole], holes


# --- shelves ------------------------------------------------------------------------------------------------


def shelf(rng: Rng) -> list[Manifold]:
    """A bookcase, cube grid, ladder, industrial rack or asymmetric shelf, with a back or without."""
    x, y, top = rng.uniform(0.45, 1.4), rng.uniform(0.22, 0.42), rng.uniform(0.7, 2.1)
    board = rng.uniform(0.016, 0.035)
    style = rng.choice(["bookcase", "grid", "posts", "ladder", "staggered"], p=[0.35, 0.2, 0.2, 0.1, 0.15])
    if style == "ladder":
        return _ladder(rng, x, max(y, 0.3), max(top, 1.3), board)
    if style == "posts":
        return _rack(rng, x, y, top, board)
    low = rng.choice([0.0, rng.uniform(0.03, 0.1)])
    parts = [box(board, y, top, (a * (x - board) / 2, 0, 0)) for a in (-1, 1)]
    rows = max(2, round((top - low) / rng.uniform(0.26, 0.42)))
    columns = 1 if style == "bookcase" and x < 0.9 else max(2, round(x / rng.uniform(0.28, 0.42)))
    levels = _divided(rng, low, top - board, rows)
    parts += [box(x, y, board, (0, 0, float(h))) for h in levels]
    spots = np.linspace(-x / 2 + board / 2, x / 2 - board / 2, columns + 1)[1:-1]
    for bottom, ceiling in itertools.pairwise(levels):
        here = (
            spots
            if style != "staggered"
            else rng.uniform(-0.4 * x, 0.4 * x, int(rng.integers(1, columns + 1)))
        )
        if style == "bookcase":
            here = spots[len(spots) // 2 : len(spots) // 2 + 1]
        parts += [box(board, y, ceiling - bottom + BITE, (float(s), 0, bottom)) for s in here]
    return parts + _filling(rng, x, y, top, levels, board)


def _filling(rng: Rng, x: float, y: float, top: float, levels: list[float], board: float) -> list[Manifold]:
    """A back, a row of doors at the bottom, a closed plinth: each of them or not."""
    parts = []
    if rng.random() < 0.6:
        parts.append(box(x, 0.01, top, (0, y / 2 - 0.005, 0)))
    if rng.random() < 0.25:
        style = handle_style(rng)
        edges = np.linspace(-x / 2, x / 2, 2 if x < 0.6 else 3)
        for k, (a, b) in enumerate(itertools.pairwise(edges)):
            side = 0.88 if k == 0 else 0.12
            parts.append(
                front(float(a), float(b), levels[0], levels[1] + board, y + 2 * FRONT, style, (side, 0.8))
            )
    if levels[0] > 0 and rng.random() < 0.5:
        parts.append(box(x, board, levels[0] + BITE, (0, -y / 2 + 0.03, 0)))
    return parts


def _rack(rng: Rng, x: float, y: float, top: float, board: float) -> list[Manifold]:
    """Boards on four posts of wood or tube, perhaps with a cross of rods behind."""
    thick, sides = rng.uniform(0.02, 0.04), int(rng.choice([4, 16]))
    out, deep = x / 2 - thick, y / 2 - thick
    spots = [(a * out, b * deep) for a in (-1, 1) for b in (-1, 1)]
    parts = [post((*s, 0.0), (*s, top), thick, thick, sides) for s in spots]
    count = max(2, round(top / rng.uniform(0.28, 0.45)))
    levels = _divided(rng, rng.uniform(0.05, 0.2), top - board - rng.choice([0.0, 0.05]), count)
    outline = rounded(x, y, rng.choice([0.0, 0.03]))
    parts += [slab(outline, board, (0, 0, float(h))) for h in levels]
    if rng.random() < 0.5:
        lo, hi = levels[0] + 0.05, levels[-1]
        parts += [bar((-out, deep, a), (out, deep, b), 0.006) for a, b in ((lo, hi), (hi, lo))]
    return parts


def _ladder(rng: Rng, x: float, y: float, top: float, board: float) -> list[Manifold]:
    """Boards that grow shallower upwards between two leaning sides."""
    count, lean = int(rng.integers(3, 6)), y - 0.12
    thick, parts = rng.uniform(0.025, 0.04), []
    for a in (-1, 1):
        out = a * (x / 2 - thick / 2)
        parts.append(post((out, -y / 2 + thick / 2, 0), (out, -y / 2 + lean + thick / 2, top), thick, thick))
        parts.append(post((out, y / 2 - thick / 2, 0), (out, y / 2 - thick / 2, top), thick, thick))
    for h in np.linspace(rng.uniform(0.1, 0.3), top - board, count).tolist():
        ahead = -y / 2 + lean * h / top
        parts.append(box(x, y / 2 - ahead, board, (0, (y / 2 + ahead) / 2, h)))
    return parts
