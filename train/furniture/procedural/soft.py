"""Upholstery and bedding: sofas, armchairs, pillows, beds."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from train.furniture.procedural.parts import (
    BITE,
    Point,
    Rng,
    bar,
    box,
    curved,
    cushion,
    dimpled,
    pole,
    rounded,
    sheared,
    slab,
    soft_box,
    superellipse,
    union,
)
from train.furniture.procedural.supports import four_legs, pedestal, sled, star

if TYPE_CHECKING:
    from manifold3d import Manifold

# --- sofas and armchairs ------------------------------------------------------------------------------------


def sofa(rng: Rng) -> list[Manifold]:
    """Two to four seats: loose cushions or one pad, arms on both sides, one or none, perhaps a chaise."""
    x, y, seat = rng.uniform(1.3, 2.4), rng.uniform(0.75, 1.0), rng.uniform(0.38, 0.46)
    arm, count = rng.uniform(0.08, 0.25), int(rng.integers(1, 4)) + (x > 1.9)
    sides = [(-1, 1), (-1,), (1,), ()][int(rng.choice(4, p=[0.7, 0.1, 0.1, 0.1]))]
    parts, inner = _body(rng, x, y, seat, arm, sides, count)
    if rng.random() < 0.25:
        parts += _chaise(rng, inner, y, seat)
    if rng.random() < 0.35:
        for _ in range(int(rng.integers(1, 3))):
            size, spot = rng.uniform(0.36, 0.46), rng.uniform(0.8 * inner[0], 0.8 * inner[1])
            loose = cushion(size, size, 0.13, (0, 0, -0.065), 6, 2, 0.06, 24).rotate(
                (65, 0, rng.uniform(-12, 12))
            )
            parts.append(loose.translate((spot, 0.08 * y, seat + 0.42 * size)))
    return parts


def armchair(rng: Rng) -> list[Manifold]:
    """One upholstered seat: a small sofa, a tub, a wing chair, or cushions in a frame of wood."""
    x, y, seat = rng.uniform(0.65, 0.95), rng.uniform(0.68, 0.92), rng.uniform(0.36, 0.46)
    style = rng.choice(["sofa", "tub", "wing", "frame"], p=[0.35, 0.25, 0.2, 0.2])
    if style == "tub":
        return _tub(rng, x, seat)
    if style == "frame":
        return _framed(rng, x, y, seat)
    arm = rng.uniform(0.08, 0.16)
    parts, _ = _body(
        rng, x, y, seat, arm, (-1, 1), 1, tall=rng.uniform(0.95, 1.1) if style == "wing" else 0.0
    )
    if style == "wing":
        deep, rise = rng.uniform(0.22, 0.34), rng.uniform(0.9, 1.0)
        for a in (-1, 1):
            wing = soft_box(0.07, deep, rise - seat, (a * (x / 2 - arm / 2), y / 2 - deep / 2, seat), 0.03)
            parts.append(wing)
    return parts


def _body(
    rng: Rng,
    x: float,
    y: float,
    seat: float,
    arm: float,
    sides: tuple[int, ...],
    count: int,
    tall: float = 0.0,
) -> tuple[list[Manifold], tuple[float, float]]:
    """Base, back, arms and cushions of `count` seats; and the span of x between the arms."""
    low, deep, soft = rng.uniform(0.04, 0.16), rng.uniform(0.14, 0.24), rng.uniform(0.1, 0.16)
    back = tall or rng.uniform(0.68, 0.92)
    left, right = -x / 2 + (arm if -1 in sides else 0), x / 2 - (arm if 1 in sides else 0)
    base = seat - soft
    parts = [soft_box(x - 0.02, y - 0.02, base - low + BITE, (0, 0, low), 0.02)]
    parts += _feet(rng, x, y, low)
    lean = rng.uniform(0.0, 0.2)
    rear = soft_box(x - 0.02, deep, back - low, (0, y / 2 - deep / 2, low), rng.uniform(0.02, 0.09))
    parts.append(sheared(rear, lean, low))
    parts += _arms(rng, x, y, low, rng.uniform(0.1, 0.26) + seat, arm, sides)
    edges, firm = np.linspace(left, right, count + 1), rng.uniform(3.5, 8)
    ahead, edge, loose = -y / 2 - rng.uniform(0.005, 0.02), rng.uniform(0.02, 0.06), rng.random() < 0.7
    pads = rng.uniform(0.1, 0.16)
    kind = rng.choice(["plain", "tufted", "channels"], p=[0.55, 0.25, 0.2])
    for a, b in itertools.pairwise(edges):
        middle, wide = float(a + b) / 2, float(b - a) + 0.006
        long = y / 2 - deep - ahead + 0.02
        parts.append(soft_box(wide, long, soft + 0.03, (middle, ahead + long / 2, base - 0.03), edge))
        if loose:
            rise = back - seat + rng.uniform(-0.06, 0.05)
            parts.append(
                _back_cushion(
                    wide, pads, rise, (middle, y / 2 - deep + lean * (seat - low), seat), firm, kind
                )
            )
    return parts, (left, right)


def _back_cushion(wide: float, deep: float, rise: float, at: Point, firm: float, kind: str) -> Manifold:
    """A cushion that leans on the back at `at`, the middle of its lower rear edge."""
    if kind == "channels":
        count = max(3, round(wide / 0.12))
        each = wide / count
        spots = (np.arange(count) + 0.5) * each - wide / 2
        rolls = [soft_box(1.12 * each, deep, rise, (float(s), 0, 0), 0.045) for s in spots]
        return union(rolls).translate((at[0], at[1] - deep / 2 + 0.05, at[2] - 0.02))
    pad = cushion(wide, rise, deep + 0.04, (0, 0, 0), firm, 3, 0, 40 if kind == "tufted" else 28)
    if kind == "tufted":
        rows = np.array([(u * wide, v * rise, deep + 0.04) for u in (-0.25, 0.0, 0.25) for v in (-0.2, 0.2)])
        pad = dimpled(pad, rows, 0.03, 0.06)
    return pad.rotate((80, 0, 0)).translate((at[0], at[1] + 0.06, at[2] + rise / 2 - 0.02))


def _feet(rng: Rng, x: float, y: float, low: float) -> list[Manifold]:
    """Four short legs, blocks, or a plinth."""
    if rng.random() < 0.25:
        return [box(x - 0.1, y - 0.1, low + 0.03, (0, 0, 0))]
    return four_legs(rng, x - 0.06, y - 0.06, low + 0.02, rng.uniform(0.035, 0.07))


def _arms(
    rng: Rng, x: float, y: float, low: float, top: float, arm: float, sides: tuple[int, ...]
) -> list[Manifold]:
    """Arms from the base to `top`: boxes, pads with a round top, rolls, or sloping ones."""
    style, parts = rng.choice(["box", "round", "roll", "slope"]), []
    edge, fall, wide = rng.uniform(0.012, 0.05), rng.uniform(0.08, 0.2), max(arm, 0.12)
    for a in sides:
        across = a * (x / 2 - arm / 2)
        if style == "round":
            parts.append(soft_box(arm, y, top - low, (across, 0, low), 0.48 * arm))
            continue
        block = soft_box(arm, y, top - low, (across, 0, low), edge)
        if style == "slope":
            block = block.trim_by_plane((0, fall, -1), -top + 0.0 * fall)
        parts.append(block)
        if style == "roll":
            roll = pole(0.62 * wide, y, (0, 0, -y / 2)).rotate((90, 0, 0))
            parts.append(roll.translate((across + a * 0.15 * wide, 0, top - 0.2 * wide)))
    return parts


def _chaise(rng: Rng, inner: tuple[float, float], y: float, seat: float) -> list[Manifold]:
    """A long seat in front of one end."""
    wide, long = min(rng.uniform(0.55, 0.75), 0.6 * (inner[1] - inner[0])), rng.uniform(0.45, 0.75)
    across = inner[0] + wide / 2 if rng.random() < 0.5 else inner[1] - wide / 2
    front = -y / 2 - long
    block = soft_box(wide, long + 0.2, seat - 0.16, (across, front + long / 2 + 0.1, 0.05), 0.02)
    pad = soft_box(wide, long + 0.2, 0.15, (across, front + long / 2 + 0.1, seat - 0.14), 0.04)
    feet = [pole(0.02, 0.08, (across + a * (wide / 2 - 0.06), front + 0.06, 0)) for a in (-1, 1)]
    return [block, pad, *feet]


def _tub(rng: Rng, x: float, seat: float) -> list[Manifold]:
    """A round shell that is back and arms at once, open in front, on legs, a star or a plinth."""
    y, wall, low = x * rng.uniform(0.9, 1.0), rng.uniform(0.07, 0.13), rng.uniform(0.06, 0.2)
    tall, squareness = rng.uniform(0.66, 0.8), rng.uniform(2.0, 4.0)
    outer = slab(superellipse(x, y, squareness), tall - low, (0, 0, low), rng.uniform(0, 0.06))
    hollow = slab(superellipse(x - 2 * wall, y - 2 * wall, squareness), 1.0, (0, 0, seat - 0.1))
    mouth = box(x - 2 * wall, y, 1.0, (0, -y / 2, seat - 0.1))
    shell = outer - hollow - mouth
    if rng.random() < 0.7:  # arms that fall toward the front
        fall = rng.uniform(0.15, 0.45)
        shell = shell.trim_by_plane((0, fall, -1), -tall + 0.1 * y * fall)
    pad = cushion(x - 2 * wall + 0.04, y - wall, 0.17, (0, -wall / 2, seat - 0.13), 2 + squareness, 4, 0, 40)
    style = rng.choice(["legs", "star", "pedestal", "plinth"])
    if style == "legs":
        base = four_legs(rng, 0.74 * x, 0.74 * y, low + 0.01, rng.uniform(0.025, 0.045))
    elif style == "star":
        base = star(rng, 0.38 * x, low + 0.05, castors=False)
    elif style == "pedestal":
        base = pedestal(rng, 0.7 * x, low + 0.01)
    else:
        base = [slab(superellipse(0.85 * x, 0.85 * y, squareness), low + 0.02)]
    return [shell, pad, *base]


def _framed(rng: Rng, x: float, y: float, seat: float) -> list[Manifold]:
    """Two cushions in an open frame: sled or legs, boards as arms, bars behind the back."""
    thick, lean, under = rng.uniform(0.03, 0.05), rng.uniform(0.2, 0.4), seat - 0.13
    inner, tall = x - 2 * thick, rng.uniform(0.4, 0.6)
    base = (
        sled(rng, x, y, under + 0.02, thick)
        if rng.random() < 0.4
        else four_legs(rng, x, y, under + 0.02, thick)
    )
    rear = y / 2 - 0.16
    parts = [*base, box(x, y - 0.02, 0.035, (0, 0, under))]
    parts.append(cushion(inner, rear + y / 2, 0.15, (0, (rear - y / 2) / 2, under + 0.02), 9, 4, 0, 32))
    pad = cushion(inner, tall, 0.15, (0, 0, 0), 8, 4, 0, 32).rotate((90, 0, 0)).translate((0, 0, tall / 2))
    bars = [bar((a * 0.36 * x, 0, 0), (a * 0.36 * x, 0, 0.9 * tall), 0.014) for a in (-1, 0, 1)]
    bars.append(bar((-0.42 * x, 0, 0.9 * tall), (0.42 * x, 0, 0.9 * tall), 0.016))
    parts += [sheared(p, lean, 0).translate((0, rear, under + 0.02)) for p in (pad, *bars)]
    rise = seat + rng.uniform(0.12, 0.2)
    for a in (-1, 1):
        out = a * (x / 2 - thick / 2)
        parts.append(slab(rounded(rng.uniform(0.05, 0.08), y, 0.025), 0.025, (out, 0, rise - 0.025)))
        ends = (-y / 2 + 0.06, y / 2 - 0.06)
        parts += [box(thick, thick, rise - under, (out, e, under)).translate((0, 0, -0.003)) for e in ends]
    return parts


# --- pillows and beds ---------------------------------------------------------------------------------------


def pillow(rng: Rng) -> list[Manifold]:
    """A square, oblong, round or roll-shaped pillow, lying or leaning, plain, dented or buttoned."""
    x, y, z = rng.uniform(0.35, 0.8), rng.uniform(0.3, 0.5), rng.uniform(0.1, 0.2)
    style = rng.choice(["square", "oblong", "round", "roll", "box"], p=[0.35, 0.3, 0.12, 0.1, 0.13])
    if style == "roll":
        z = rng.uniform(0.14, 0.24)
        solid = cushion(z, z, x, (0, 0, -x / 2), 2, rng.uniform(5, 12), 0, 56).rotate((0, 90, 0))
    elif style == "box":
        solid = cushion(x, y, 0.7 * z, (0, 0, -0.35 * z), rng.uniform(8, 14), rng.uniform(5, 9), 0, 56)
    else:
        y = x if style in ("square", "round") else min(y, 0.8 * x)
        plan = 2.0 if style == "round" else rng.uniform(4, 9)
        pinch = 0.0 if style == "round" else rng.uniform(0.0, 0.14)
        solid = cushion(x, y, z, (0, 0, -z / 2), plan, rng.uniform(1.8, 2.8), pinch, 56)
    if rng.random() < 0.45:
        count = int(rng.integers(1, 4))
        spots = np.column_stack([rng.uniform(-0.22, 0.22, (count, 2)) * (x, y), np.full(count, 0.5 * z)])
        solid = dimpled(solid, spots, rng.uniform(0.15, 0.4) * z, rng.uniform(0.06, 0.16))
    bow = rng.choice([0.0, rng.uniform(-0.05, 0.05)])
    solid = solid.rotate((-90, 0, 0))
    solid = curved(solid, bow, x, 0.1) if bow else solid
    return [solid.rotate((90 - rng.choice([0.0, rng.uniform(40, 80)]), 0, rng.uniform(-5, 5)))]


def bed(rng: Rng) -> list[Manifold]:
    """Single to king size: frame on legs, boxed or upholstered; headboards of many kinds, pillows, blanket."""
    x, y, low = (
        rng.choice([0.9, 1.2, 1.4, 1.6, 1.8]) + rng.uniform(-0.03, 0.08),
        rng.uniform(1.95, 2.15),
        rng.uniform(0.05, 0.28),
    )
    frame, soft = rng.uniform(0.08, 0.22), rng.uniform(0.12, 0.26)
    if rng.random() < 0.6:
        parts = [box(x, y, frame, (0, 0, low)), *four_legs(rng, x, y, low, rng.uniform(0.05, 0.1))]
    else:
        parts = [soft_box(x, y, low + frame, (0, 0, 0), rng.uniform(0.015, 0.05))]
    top = low + frame + soft
    parts.append(
        soft_box(0.96 * x, 0.97 * y, soft + 0.03, (0, 0, low + frame - 0.03), rng.uniform(0.03, 0.07))
    )
    parts += _headboard(rng, x, y, top + rng.uniform(0.15, 0.6))
    if rng.random() < 0.35:
        parts.append(slab(rounded(x, 0.045, 0), top + rng.uniform(-0.1, 0.25), (0, -y / 2 + 0.01, 0)))
    count = 1 if x < 1.3 else 2
    firm, wide, deep = rng.uniform(4, 8), 0.84 * x / count, rng.uniform(0.38, 0.5)
    for k in range(count):
        across = (k - (count - 1) / 2) * 0.92 * x / count
        pillow_ = cushion(wide, deep, rng.uniform(0.11, 0.17), (0, 0, 0), firm, 2, 0.05, 32)
        parts.append(
            pillow_.rotate((rng.choice([0, 20]), 0, 0)).translate((across, y / 2 - 0.4, top - 0.035))
        )
    if rng.random() < 0.5:  # a blanket that hangs over the sides
        long = rng.uniform(0.35, 0.68) * y
        hang = rng.uniform(0.3, 0.9) * soft
        parts.append(soft_box(x + 0.03, long, hang + 0.04, (0, -y / 2 + long / 2 + 0.05, top - hang), 0.03))
    return parts


def _headboard(rng: Rng, x: float, y: float, tall: float) -> list[Manifold]:
    """A board, an arch, upholstery in fields, rails, or upright bars; all from the floor."""
    style, rear = rng.choice(["board", "arch", "padded", "bars", "rails"]), y / 2
    if style == "board":
        wide = x + rng.choice([0.0, rng.uniform(0.0, 0.6)])
        outline = rounded(wide, tall, 0.0)
        return [
            slab(outline, rng.uniform(0.03, 0.06)).rotate((90, 0, 0)).translate((0, rear + 0.03, tall / 2))
        ]
    if style == "arch":
        board = slab(superellipse(x, 2 * tall, rng.uniform(2.2, 5), 56), 0.04).rotate((90, 0, 0))
        return [board.translate((0, rear + 0.025, 0)).trim_by_plane((0, 0, 1), 0.0)]
    if style == "padded":
        count = int(rng.integers(1, 7))
        each = x / count
        spots = (np.arange(count) + 0.5) * each - x / 2
        pads = [soft_box(each + 0.008, 0.1, tall - 0.2, (float(s), rear + 0.01, 0.2), 0.04) for s in spots]
        return [*pads, box(x, 0.03, tall - 0.05, (0, rear + 0.03, 0))]
    posts = [box(0.06, 0.05, tall, (a * (x / 2 - 0.03), rear + 0.015, 0)) for a in (-1, 1)]
    rail = box(x, 0.035, 0.07, (0, rear + 0.015, tall - 0.09))
    if style == "rails":
        heights = np.linspace(0.4 * tall, tall - 0.2, int(rng.integers(1, 4)))
        return [*posts, rail, *(box(x, 0.03, 0.07, (0, rear + 0.015, float(h))) for h in heights)]
    spots = np.linspace(-x / 2 + 0.03, x / 2 - 0.03, round(x / rng.uniform(0.09, 0.16)) + 1)[1:-1]
    bars = [bar((float(s), rear + 0.015, 0.25), (float(s), rear + 0.015, tall - 0.06), 0.01) for s in spots]
    return [*posts, rail, box(x, 0.035, 0.07, (0, rear + 0.015, 0.23)), *bars]
